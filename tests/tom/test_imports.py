"""The order of imports is the order of the tree: a room imports from the rooms below it alone.

A room is a package, or one of the few modules that lie beside the packages.
"""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = {  # from the top down; README.md draws the same tree
    "tom": (
        "__main__",
        "cli",
        "bench",
        "sweep",
        "studies",
        "reports",
        "analysis",
        "training",
        "offline",
        "mbpo",
        "record",
        "road",
        "policy",
        "exams",
        "learners",
        "dynamics",
        "envs",
        "nn",
        "events",
        "data",
        "machine",
        "config",
        "metrics",
        "rng",
        "harmless",
        "errors",
    ),
    "app": (
        "__main__",
        "servers",
        "router",
        "views",
        "parts",
        "scenes",
        "figures",
        "data",
        "session",
        "guard",
        "links",
        "theme",
        "text",
    ),
}
FILES = [path for package in ROOMS for path in sorted((ROOT / package).rglob("*.py"))]


def name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name(path): path for path in FILES}
each_file = pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))


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


@each_file
def test_imports_point_down(path: Path):
    package, own = room(name(path))
    if not own:
        return
    rooms = ROOMS[package]
    for module in imported(path):
        top, other = room(module)
        if top == package and other:
            assert rooms.index(own) <= rooms.index(other), f"{path} imports {module}"


def test_no_modules_import_each_other():
    graph = {m: {i for i in imported(p) if i in MODULES and i != m} for m, p in MODULES.items()}
    TopologicalSorter(graph).prepare()  # raises where there is a circle


@each_file
def test_the_backend_knows_nothing_of_the_studio(path: Path):
    if path.relative_to(ROOT).parts[0] == "app":
        return
    top = {module.partition(".")[0] for module in imported(path)}
    assert not top & {"app", "streamlit", "plotly", "viser"}
    if path.parent != ROOT / "tom" / "record" / "rerun":
        assert "rerun" not in top


def test_learners_never_import_each_other():
    registry = imported(MODULES["tom.learners"])
    learners = {m for m in registry if m.startswith("tom.learners.")} - {"tom.learners.base"}
    assert {"tom.learners.mle", "tom.learners.tom"} <= learners
    for learner in learners:
        assert not imported(MODULES[learner]) & learners - {learner}
