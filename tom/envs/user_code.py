"""Code that the user named: its import, and a test call of a rule of termination."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from tom.envs.task import Task, Termination
from tom.errors import OF_USERS, UserError, reason


def import_named(module: str, option: str) -> ModuleType:
    """Import the module that the user named in `option`, also from the current folder.

    Raises UserError if it cannot be imported.
    """
    here = str(Path.cwd())
    sys.path.append(here)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{option}: no module '{error.name}': install it, or start from the folder it is in"
        ) from error
    except OF_USERS as error:  # errors of the user's code
        raise UserError(
            f"{option}: module '{module}' cannot be imported: "
            f"{type(error).__name__}: {reason(error)}"
        ) from error
    finally:
        sys.path.remove(here)


def tried(given: Termination, known: Task, name: str) -> Termination:
    """`given`, after a test call. Raises UserError if its answer is not a valid one."""
    try:
        answer = given(torch.zeros(3, known.obs_dim))
    except OF_USERS as error:  # the user's own code
        raise UserError(
            f"termination {name} fails for next observations (3, {known.obs_dim}): "
            f"{type(error).__name__}: {reason(error)}"
        ) from error
    if not isinstance(answer, Tensor) or answer.shape != (3,) or answer.dtype != torch.bool:
        raise UserError(
            f"termination {name} must map next observations (B, {known.obs_dim}), a tensor, to a "
            "bool tensor (B,)"
        )
    return given
