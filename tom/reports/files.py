"""The numbers behind a figure, as a file."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

from tom.harmless import cell


def write_csv(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """One line for each row, the first row's keys as the titles; no rows, an empty file."""
    listed = list(rows)
    with path.open("w", newline="") as file:
        if listed:
            writer = csv.DictWriter(file, list(listed[0]))
            writer.writerow({name: cell(name) for name in listed[0]})
            writer.writerows({name: cell(value) for name, value in row.items()} for row in listed)
