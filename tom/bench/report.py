"""The bench's tables as Markdown, put between two lines of a page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tom.errors import UserError

BEGIN, END = "<!-- bench -->", "<!-- /bench -->"


def page(found: Mapping[str, Any]) -> str:
    """What `tom bench --json` prints (`gflops`, `matmul`, `parts`, `hours`, `not_measured`)."""
    head = ("part", "CPU ms", "lowest to highest", "times the floor", "times ours", "target")
    parts = [
        (
            row["part"],
            _number(row["ms"]),
            f"{_number(row['low_ms'])} to {_number(row['high_ms'])}",
            _number(row["times_floor"]),
            _number(row["times_ours"]),
            _target(row),
        )
        for row in found["parts"]
    ]
    hours = [[_number(value) for value in row.values()] for row in found["hours"]]
    return "\n\n".join(
        (
            f"One thread, medians; {found['gflops']:.0f} GFLOP/s in 256^3 products "
            f"({found['matmul']}).",
            _table(head, parts),
            "TOM on one core, hours at most:",
            _table(list(found["hours"][0]), hours),
            f"Not measured: {'; '.join(found['not_measured'])}.",
        )
    )


def put(path: Path, text: str) -> None:
    """Put `text` between the lines BEGIN and END of the file. Raises UserError without them."""
    before, after = require_place(path)
    path.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")


def require_place(path: Path) -> tuple[str, str]:
    """What stands before BEGIN and after END. Raises UserError where there is no such place."""
    try:
        before, begin, rest = path.read_text().partition(f"{BEGIN}\n")
    except OSError as error:
        raise UserError(f"--into {path}: {error.strerror}") from None
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise UserError(f"--into {path}: give it a line {BEGIN} and a line {END} after it")
    return before, after


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _target(row: Mapping[str, Any]) -> str:
    if row["target"] is None:
        return "-"
    return f"{row['target']}: {'met' if row['met'] else '**missed**'}"


def _number(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
