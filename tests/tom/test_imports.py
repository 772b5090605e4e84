"""Imports point one way: app -> tom, and inside tom from the command line down to the maths."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LEVELS = [
    {"errors", "rng", "metrics", "config", "events", "nn", "backprop", "matmul", "data", "envs"}
    | {"adam", "graphs", "nested", "parent", "lockstep", "memory", "divergences", "statistics"}
    | {"health", "device", "address", "energy"},
    {"learners", "sac", "sac_work", "dynamics", "evaluate", "tabular", "planner", "cloning"}
    | {"collect", "policy_file", "road_policy"},
    {"rollout", "diagnostics", "exam", "presets", "road_measure", "road_model"},
    {"mbpo", "offline", "sweep", "record", "sac_recording", "progression"},
    {"run", "bench", "ordered_data"},
    {"weighing"},
    {"resume"},
    {"fleet"},
    {"imagine"},
    {"studies"},
    {"reports"},
    {"doctor", "cli", "__main__"},
]
LEARNERS = {"mle", "pmac", "ratio", "tom", "vagram", "baselines"}


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{a.name}" for a in node.names)}
    return names


def level(part: str) -> int:
    for number, parts in enumerate(LEVELS):
        if part in parts:
            return number
    pytest.fail(f"tom/{part} has no place in tests/tom/test_imports.py")


@pytest.mark.parametrize("path", modules("tom"), ids=lambda p: str(p.relative_to(ROOT)))
def test_the_backend_knows_nothing_of_the_studio(path: Path):
    top = {name.split(".")[0] for name in imported(path)}
    assert not top & {"app", "streamlit", "plotly", "viser"}
    if path.parent != ROOT / "tom" / "record" / "rerun":
        assert "rerun" not in top


@pytest.mark.parametrize("path", modules("tom"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path: Path):
    part = path.relative_to(ROOT / "tom").parts[0].removesuffix(".py")
    if part == "__init__":
        return
    for name in imported(path):
        words = name.split(".")
        if words[0] == "tom" and len(words) > 1 and (ROOT / "tom" / words[1]).exists():
            assert level(words[1]) <= level(part), f"{path} imports {name}"


@pytest.mark.parametrize("name", sorted(LEARNERS))
def test_learners_never_import_each_other(name: str):
    path = ROOT / "tom" / "learners" / f"{name}.py"
    others = {f"tom.learners.{other}" for other in LEARNERS - {name}}
    assert not imported(path) & others
