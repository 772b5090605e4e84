"""Code that the user named: its import and its errors."""

import importlib
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import Any

from tom.errors import USER_CODE_ERRORS, DivergedError, OwnCodeError, UserError, reason
from tom.machine.memory import is_out_of_memory

_LIBRARY_PATHS = (
    "site-packages",
    "<frozen",
    sysconfig.get_path("stdlib"),
    str(Path(__file__).parents[1]),
)
"""parts of the paths of libraries, of Python itself and of this package"""
_USER_MODULES: dict[str, ModuleType] = {}
"""the modules that the user named to this process, by what he wrote"""


@contextmanager
def running_user_code(what: str) -> Iterator[None]:
    """The block runs code of the user's, which `what` names.

    Raises OwnCodeError, with the place of the error, for whatever it raises, except for lack of
    memory and for errors that explain themselves.
    """
    try:
        yield
    except (UserError, DivergedError):
        raise
    except USER_CODE_ERRORS as error:
        if is_out_of_memory(error):
            raise
        raise OwnCodeError(
            f"{what} fails: {type(error).__name__}: {reason(error)}{error_location(error)}"
        ) from error
    finally:
        import torch  # it takes seconds, and who only shows runs does without it

        torch.set_default_dtype(torch.float32)  # code that computes in double may have changed it


def error_location(error: BaseException) -> str:
    """The file and line of the user's that an error comes from, in brackets; empty if unknown."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if not any(part in f.filename for part in _LIBRARY_PATHS)]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


def import_named(module: str, option: str, file: Path | None = None) -> ModuleType:
    """Import the module that the user named in `option`, also from the current folder.

    The folder stays on the path: the module may import its neighbours later. A `file` is a module
    that lies anywhere. Raises UserError if it cannot be imported.
    """
    import torch

    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)
    try:
        found = importlib.import_module(module) if file is None else _run_file(file)
        register_module(module, found)
        torch.set_default_dtype(torch.float32)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{option}: no module '{error.name}': install it, or start from the folder it is in"
        ) from error
    except USER_CODE_ERRORS as error:  # errors of the user's code
        raise UserError(
            f"{option}: module '{module}' cannot be imported: "
            f"{type(error).__name__}: {reason(error)}{error_location(error)}"
        ) from error
    return found


def _run_file(file: Path) -> ModuleType:
    name = f"tom_plugin_{re.sub(r'[^A-Za-z0-9]', '_', file.stem)}"
    loader = SourceFileLoader(name, str(file))
    spec = spec_from_loader(name, loader)
    assert spec is not None
    module = sys.modules[name] = module_from_spec(spec)
    loader.exec_module(module)
    return module


def import_function(name: str, option: str) -> Callable[..., Any]:
    """The function `module:function` that the user named in `option`. Raises UserError."""
    module, _, function = name.partition(":")
    found = getattr(import_named(module, f"{option} {name}"), function, None)
    if not callable(found):
        raise UserError(f"{option} {name}: module '{module}' has no function '{function}'")
    return found


def register_module(name: str, module: ModuleType) -> None:
    """Keep a module that the user named by `name`, for `user_code_paths`."""
    _USER_MODULES[name] = module


def user_code_paths() -> list[Path]:
    """The files, and the folders of packages, of the modules that the user named, in order."""
    found: set[Path] = set()
    for module in _USER_MODULES.values():
        top = sys.modules.get(module.__name__.partition(".")[0], module)
        places = getattr(top, "__path__", None) or [getattr(top, "__file__", None)]
        found.update(Path(place) for place in places if place and Path(place).exists())
    return sorted(found)
