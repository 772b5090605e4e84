"""Tables as wide as the terminal, or in full width elsewhere, and the summary of a run."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tom import readable
from tom.harmless import is_number, terminal, terminal_lines
from tom.record import RunReader, Store

WIDTH = 1000  # in a file or a pipe, where a row is one line


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; columns of numbers are aligned to the right."""
    listed = [list(row) for row in rows]
    table = Table()
    for i, column in enumerate(columns):
        known = [row[i].replace(",", "") for row in listed if row[i] != readable.UNKNOWN]
        numeric = bool(listed) and all(map(is_number, known))
        table.add_column(terminal(column), justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        # Text objects, because Rich would read brackets in strings as markup.
        table.add_row(*(Text(terminal_lines(cell)) for cell in row))
    console = Console(width=None if Console().is_terminal else WIDTH)
    # The table's own title would be wrapped to the width of the table.
    console.print(Text(terminal(title), style="italic"))
    console.print(table)


def show_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a table whose columns are the keys of its rows, all with the same keys."""
    show(title, list(rows[0]), [list(map(readable.cell, row.values())) for row in rows])


def print_problems(store: Store) -> None:
    """Print on stderr what `store.runs()` left out."""
    for problem in store.problems:
        print(terminal(problem), file=sys.stderr)


def summary(run: RunReader) -> dict[str, Any]:
    """A run's last and best return and its folder."""
    status = run.status
    return {
        "run_id": run.run_id,
        "env": run.env,
        "learner": run.learner,
        "seed": run.seed,
        "state": status.state,
        "env_step": status.env_step,
        "last_return": status.last_return,
        "best_return": status.best_return,
        "path": str(run.path),
    }
