"""Tables as wide as the terminal, or in full width elsewhere, and what a table says of a run."""

import sys
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tom import readable
from tom.harmless import is_number, terminal, terminal_lines
from tom.record import RunReader, Status, Store

WIDTH = 1000  # in a file or a pipe, where a row is one line


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; columns of numbers are aligned to the right."""
    listed = [list(row) for row in rows]
    table = Table()
    for i, column in enumerate(columns):
        numeric = bool(listed) and all(_is_number(row[i]) for row in listed)
        table.add_column(terminal(column), justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        # Text objects, because Rich would read brackets in strings as markup.
        table.add_row(*(Text(terminal_lines(cell)) for cell in row))
    console = Console(width=None if Console().is_terminal else WIDTH)
    # The table's own title would be wrapped to the width of the table.
    console.print(Text(terminal(title), style="italic"))
    console.print(table)


def _is_number(shown: str) -> bool:
    return shown == readable.UNKNOWN or is_number(shown.replace(",", ""))


def name_problems(store: Store) -> None:
    """Print what `store.runs()` left out, apart from the output that a script reads."""
    for problem in store.problems:
        print(terminal(problem), file=sys.stderr)


def summary(done: RunReader, status: Status | None = None) -> dict[str, Any]:
    """A run's last and best return and its folder; `status` is read if None."""
    status = status or done.status
    return {
        "run_id": done.run_id,
        "env": done.env,
        "learner": done.learner,
        "seed": done.seed,
        "state": status.state,
        "env_step": status.env_step,
        "last_return": status.last_return,
        "best_return": status.best_return,
        "path": str(done.path),
    }
