"""Mend the text of a file of rows: a damaged line is filled or blanked, every other one stays where
it is, because checkpoints hold the length of the file.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from tom.record.decode import numbers
from tom.record.files import parse_json_line


class Mended(NamedTuple):
    """A mended text; how many lines there were, how many were damaged, and how many put back."""

    content: bytes
    lines: int
    damaged: int
    put_back: int


class Lost(NamedTuple):
    """What no whole line says of a step; it comes after line `after`, to count instead of it."""

    step: int
    line: bytes
    after: int


def mend_lines(content: bytes, table: pd.DataFrame | None = None) -> Mended:
    """Blank the damaged lines of `content`; with `table`, put the rows that it lacks there.

    `table` is what the lines are known to have said: one that says otherwise is damaged, too. Rows
    that fit no place come at the end.
    """
    *lines, half = content.split(b"\n")
    rows = [parse_json_line(line) for line in lines]
    good, lost = [row is not None for row in rows], []
    if table is not None:
        good, lost = _compared(rows, table, cut_off=bool(half))
    put_back = len(lost)
    mended = [
        line if good[i] else _own(i, rows[i], lost) or _filled(i, len(line), lost)
        for i, line in enumerate(lines)
    ]
    text = b"".join(line + b"\n" for line in [*mended, *(row.line for row in lost)])
    bad = [half, *(line for line, whole in zip(lines, good, strict=True) if not whole)]
    damaged = sum(bool(line.strip()) for line in bad)
    return Mended(text, sum(good) + damaged, damaged, put_back)


def _compared(
    rows: Sequence[Mapping[str, Any] | None], table: pd.DataFrame, *, cut_off: bool
) -> tuple[list[bool], list[Lost]]:
    """Which rows agree with the table, and what they lack.

    Of two values of a metric at a step the later one is in the table. So a row may also differ from
    it, if the later one may have been in a line that is damaged.
    """
    true: dict[int, dict[str, float]] = {
        int(row["env_step"]): numbers({str(name): row[name] for name in row})
        for row in table.to_dict("records")
    }
    left, after, good, gap = dict(true), dict.fromkeys(true, -1), [False] * len(rows), cut_off
    for i, row in reversed([*enumerate(rows)]):
        step = row.get("env_step") if row is not None else None
        if row is None:
            gap = True
        if row is None or not isinstance(step, int) or step not in true:
            continue
        values, missing = numbers(row), left.get(step, {})
        differs = any(missing.get(name, value) != value for name, value in values.items())
        if not values.keys() <= true[step].keys() or (differs and not gap):
            continue
        good[i] = True
        if differs:
            after[step] = max(after[step], i)
        left[step] = {name: value for name, value in missing.items() if values.get(name) != value}
        if not left[step]:
            del left[step]
    return good, [Lost(step, _line(step, values), after[step]) for step, values in left.items()]


def _own(number: int, row: Mapping[str, Any] | None, lost: list[Lost]) -> bytes | None:
    """What is lost of the step in line `number`, taken away from `lost`.

    In its own length, because a hand that changed the line may have changed that.
    """
    step = row.get("env_step") if row is not None else None
    own = next((one for one in lost if one.step == step and one.after < number), None)
    if own is None:
        return None
    lost.remove(own)
    return own.line


def _filled(number: int, length: int, lost: list[Lost]) -> bytes:
    """As many of `lost` as line `number` has room for, taken away from there, and blanks."""
    here: list[bytes] = []
    for row in [*lost]:
        if row.after < number and len(b"\n".join([*here, row.line])) <= length:
            here.append(row.line)
            lost.remove(row)
    return b"\n".join(here).ljust(length)


def _line(step: int, values: Mapping[str, float]) -> bytes:
    return json.dumps({"env_step": step, **values}, separators=(",", ":")).encode()
