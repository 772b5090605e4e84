"""Makes tests/FAULTS.md from the names of the tests: `python tests/fault/table.py`.

A fault test is called `test_<fault>__<outcome>`; the table is those names in plain words.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

TESTS = Path(__file__).parents[1]
TABLE = TESTS / "FAULTS.md"
HEAD = """# Faults and what comes of them

Made from the tests' names by `python tests/fault/table.py`; a test holds it up to date.
`pytest -m fault` runs the whole list. What says *always* belongs to the default tests as well.
"""


@dataclass(frozen=True)
class Fault:
    """One row of the table."""

    fault: str
    outcome: str
    always: bool
    times: int


def sections() -> Iterator[tuple[str, str, list[Fault]]]:
    """(title, path, faults) of every test file that injects some."""
    for path in sorted(TESTS.rglob("test_*.py")):
        tree = ast.parse(path.read_text())
        marks = _module_marks(tree)
        found = [f for node in tree.body if (f := _fault(node, marks)) is not None]
        if found:
            title = (ast.get_docstring(tree) or path.stem).splitlines()[0]
            yield title, path.relative_to(TESTS).as_posix(), found


def unnamed() -> list[str]:
    """Fault tests of this folder whose name does not say what is expected."""
    found = []
    for path in sorted(Path(__file__).parent.glob("test_*.py")):
        tree = ast.parse(path.read_text())
        marks = _module_marks(tree)
        for node in tree.body:
            if not isinstance(node, ast.FunctionDef) or not node.name.startswith("test_"):
                continue
            if "fault" in marks | _marks(node) and "__" not in node.name:
                found.append(f"{path.name}: {node.name}")
    return found


def table() -> str:
    """The content of FAULTS.md."""
    parts, count = [HEAD], 0
    for title, path, faults in sections():
        count += len(faults)
        parts += [f"\n## {title}\n\n`tests/{path}`\n", "\n| fault | what comes of it | run |\n"]
        parts.append("|---|---|---|\n")
        for f in faults:
            times = f" ({f.times} cases)" if f.times > 1 else ""
            when = "always" if f.always else "-m fault"
            parts.append(f"| {f.fault}{times} | {f.outcome} | {when} |\n")
    parts[0] += f"\n{count} faults.\n"
    return "".join(parts)


def _fault(node: ast.stmt, module_marks: set[str]) -> Fault | None:
    marks = module_marks | _marks(node)
    if "fault" not in marks:
        return None
    if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
        return Fault(_words(node.name), ast.get_docstring(node) or "", "quick" in marks, 1)
    if not isinstance(node, ast.FunctionDef) or not node.name.startswith("test_"):
        return None
    fault, _, outcome = node.name.removeprefix("test_").partition("__")
    return Fault(_words(fault), _words(outcome) or "as it says", "quick" in marks, _cases(node))


def _words(name: str) -> str:
    """`a_full_disk` and `TestAFullDisk` -> `a full disk`."""
    spaced = re.sub("([A-Z])", r" \1", name.removeprefix("Test")) if "_" not in name else name
    return spaced.replace("_", " ").strip().lower()


def _module_marks(tree: ast.Module) -> set[str]:
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark":
            return _names(node.value)
    return set()


def _marks(node: ast.stmt) -> set[str]:
    decorators = getattr(node, "decorator_list", [])
    return {name for decorator in decorators for name in _names(decorator)}


def _names(node: ast.expr) -> set[str]:
    """The names of the marks in an expression."""
    words = (ast.unparse(n) for n in ast.walk(node) if isinstance(n, ast.Attribute))
    return {word.removeprefix("pytest.mark.") for word in words if word.startswith("pytest.mark.")}


def _cases(node: ast.FunctionDef) -> int:
    """How many cases a list in the decorator makes of the test; 1 where it is no list."""
    for decorator in node.decorator_list:
        if isinstance(decorator, ast.Call) and "parametrize" in ast.unparse(decorator.func):
            values = decorator.args[1]
            return len(values.elts) if isinstance(values, ast.List) else 1
    return 1


if __name__ == "__main__":
    TABLE.write_text(table())
