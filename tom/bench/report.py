"""The bench's tables as Markdown, written between two marker lines of a page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tom import readable
from tom.errors import UserError, reason
from tom.record.files import replace

BEGIN, END = "<!-- bench -->", "<!-- /bench -->"


def page(measured: Mapping[str, Any]) -> str:
    """The tables for the output of `tom bench --json`."""
    head = ("part", "CPU ms", "lowest to highest", "times the floor", "times ours", "target")
    parts = [
        (
            row["part"],
            readable.cell(row["ms"]),
            f"{readable.cell(row['low_ms'])} to {readable.cell(row['high_ms'])}",
            readable.cell(row["times_floor"]),
            readable.cell(row["times_ours"]),
            f"{row['target']}: {'met' if row['met'] else '**missed**'}" if row["target"] else "-",
        )
        for row in measured["parts"]
    ]
    hours = [[readable.cell(value) for value in row.values()] for row in measured["hours"]]
    return "\n\n".join(
        (
            f"One thread, medians; {measured['gflops']:.0f} GFLOP/s in 256^3 products "
            f"({measured['matmul']}).",
            _table(head, parts),
            "TOM on one core, hours at most:",
            _table(list(measured["hours"][0]), hours),
            f"Not measured: {'; '.join(measured['not_measured'])}.",
        )
    )


def put(path: Path, text: str) -> None:
    """Replace the text between the lines BEGIN and END. Raises UserError if they are missing."""
    before, after = require_place(path)
    whole = f"{before}{BEGIN}\n{text}\n{END}{after}".encode()
    replace(path, lambda file: file.write(whole), sync=False)


def require_place(path: Path) -> tuple[str, str]:
    """The text before BEGIN and after END. Raises UserError if they are missing."""
    try:
        before, begin, rest = path.read_text().partition(f"{BEGIN}\n")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--into {path}: {reason(error)}: name a text file") from None
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise UserError(f"--into {path}: give it a line {BEGIN} and a line {END} after it")
    return before, after


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
