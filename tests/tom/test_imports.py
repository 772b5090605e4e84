"""The order of imports is the order of the tree: a room imports from the rooms below it alone.

A room is a package, or one of the few modules that lie beside the packages.
"""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from itertools import takewhile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TREE = (ROOT / "docs/architecture.md").read_text().partition("```")[2].partition("```")[0]


def rooms_of(package: str) -> list[str]:
    """The rooms of a package from the top down, as docs/architecture.md draws them."""
    drawn = TREE.partition(f"{package}/ ")[2].splitlines()[1:]
    lines = takewhile(lambda line: line.startswith(" "), drawn)
    names = [re.sub("(/ |  ).*", "", line.strip()).split(", ") for line in lines]
    places = [ROOT / package / name for part in names for name in part]
    return ["__main__", *(p.name for p in places if p.is_dir() or p.with_suffix(".py").exists())]


ROOMS = {package: rooms_of(package) for package in ("tom", "app")}
FILES = [path for package in ROOMS for path in sorted((ROOT / package).rglob("*.py"))]


def name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name(path): path for path in FILES}


@cache
def imported(path: Path) -> set[str]:
    """Every module that a file imports, wherever in it: `a.b` for `from a import b` if b is one."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.module, f"{path}: a relative import"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & MODULES.keys() or {node.module}
    return found


def room(module: str) -> tuple[str, str]:
    """(package, room) of a module; the package's own file is in no room."""
    package, _, rest = module.partition(".")
    return package, rest.partition(".")[0]


def test_every_room_has_its_place():
    for package, rooms in ROOMS.items():
        assert {room(m)[1] for m in MODULES if m.startswith(f"{package}.")} == set(rooms)


def test_imports_point_down():
    for path in FILES:
        package, own = room(name(path))
        for module in imported(path) if own else ():
            top, other = room(module)
            if top == package and other:
                rooms = ROOMS[package]
                assert rooms.index(own) <= rooms.index(other), f"{path} imports {module}"


def test_no_modules_import_each_other():
    graph = {m: {i for i in imported(p) if i in MODULES and i != m} for m, p in MODULES.items()}
    TopologicalSorter(graph).prepare()  # raises where there is a circle


def test_the_backend_knows_nothing_of_the_studio():
    for path in (ROOT / "tom").rglob("*.py"):
        top = {module.partition(".")[0] for module in imported(path)}
        assert not top & {"app", "streamlit", "plotly", "viser"}, path
        assert path.parent == ROOT / "tom" / "record" / "rerun" or "rerun" not in top, path


def loaded(code: str) -> set[str]:
    """The modules of a process that runs this line of Python, and ends well."""
    script = f"import sys\ntry:\n    {code}\nfinally:\n    print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.split())


LIBRARIES = {"torch", "scipy", "matplotlib", "mujoco", "gymnasium", "rerun", "streamlit"}


@pytest.mark.parametrize(
    ("words", "others"),
    [
        (["--version"], {"numpy", "pandas", "pydantic"}),
        (["--help"], {"numpy", "pandas", "pydantic"}),
        (["runs", "list", "--store", "runs"], set()),
    ],
)
def test_a_command_that_only_reads_imports_no_heavy_library(words: list[str], others: set[str]):
    assert not (LIBRARIES | others) & loaded(f"from tom.cli import main; main({words})")


@pytest.mark.parametrize(
    ("module", "its_own"),
    [
        ("app.servers.launcher", set()),
        ("app.servers.pages", {"streamlit"}),
        ("app.scenes.server", set()),
        ("tom.record.rerun.viewer", set()),
    ],
)
def test_a_server_of_the_studio_starts_without_heavy_libraries(module: str, its_own: set[str]):
    assert LIBRARIES & loaded(f"import {module}") == its_own


def test_the_studio_reads_run_folders_through_one_module():
    """`app/data/readers.py` makes the readers; `app/servers/bench.py` writes its own runs."""
    for module, path in MODULES.items():
        if not module.startswith("app.") or module == "app.servers.bench":
            continue
        calls = (node for node in ast.walk(ast.parse(path.read_text())) if _makes_reader(node))
        assert module == "app.data.readers" or not list(calls), module
        assert "tom.record.layout" not in imported(path), module


def test_there_is_one_way_to_start_a_process():
    for module, path in MODULES.items():
        if module != "tom.machine.processes":
            names = {ast.unparse(node) for node in ast.walk(ast.parse(path.read_text()))}
            assert "subprocess.Popen" not in names, module


def _makes_reader(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func) == "RunReader"


def test_learners_never_import_each_other():
    room_of_learners = {m: p for m, p in MODULES.items() if m.startswith("tom.learners.")}
    weighs = {m for m, path in room_of_learners.items() if "def weigh(" in path.read_text()}
    learners = weighs - {"tom.learners.base"}
    assert {"tom.learners.mle", "tom.learners.tom"} <= learners
    for learner in learners:
        assert not imported(MODULES[learner]) & learners - {learner}
