"""The rows of `metrics.jsonl` as a table, also for hundreds of megabytes."""

from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.json

from tom.data.unpack import read_bytes
from tom.record import decode
from tom.record.files import parse_json_line, read_json_lines

LARGE_BYTES = 4_000_000
"""from this size on, rows are read as columns, in a tenth of the time"""

BLOCK_BYTES = 8_000_000


def read_metrics(path: Path) -> tuple[pd.DataFrame, list[str]]:
    """The table of metric rows, and the errors of skipped lines.

    Raises OSError if the file cannot be read.
    """
    if path.stat().st_size < LARGE_BYTES:
        return _by_row(path)
    try:
        table, problems = _columns(path)
        return decode.tidy(table), problems
    except (pa.ArrowException, KeyError, ValueError):  # a row does not fit the columns
        return _by_row(path)


def _by_row(path: Path) -> tuple[pd.DataFrame, list[str]]:
    rows, problems = read_json_lines(path)
    return decode.metrics_table(rows), problems


def _columns(path: Path) -> tuple[pd.DataFrame, list[str]]:
    content = read_bytes(path)
    whole = content[: content.rfind(b"\n") + 1]
    lines = whole.count(b"\n")
    flat = b"[" not in whole and whole.count(b"{") == lines
    if not flat or (b"\n" + whole).count(b"\n{") != lines:
        # Nested values and a bare `null` crash Arrow's parser and the process.
        raise ValueError("not every line is one flat object")
    half = len(whole) < len(content)
    problems = [f"{path.name}: the last line is half written and was skipped"] if half else []
    try:
        return _parse(whole), problems
    except pa.ArrowException:
        good, bad = _without_damage(whole, path.name)
        return _parse(good), [*bad, *problems]


def _parse(lines: bytes) -> pd.DataFrame:
    options = pyarrow.json.ReadOptions(use_threads=False, block_size=BLOCK_BYTES)
    table = pyarrow.json.read_json(pa.BufferReader(lines), read_options=options)
    if not pa.types.is_integer(table.schema.field("env_step").type):
        raise ValueError("some row has no env_step")
    if table["env_step"].null_count:
        raise ValueError("some row has no env_step")
    return table.to_pandas(use_threads=False)


def _without_damage(lines: bytes, name: str) -> tuple[bytes, list[str]]:
    good: list[bytes] = []
    problems: list[str] = []
    for number, line in enumerate(lines.splitlines(), start=1):
        if parse_json_line(line) is not None:
            good.append(line)
        elif line:
            problems.append(f"{name}: line {number} is damaged and was skipped")
    return b"\n".join(good), problems
