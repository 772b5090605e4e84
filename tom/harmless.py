"""Words that came from a run's files, made harmless for where they are written.

Settings, notes, names and error texts are anybody's: a store may have been copied from elsewhere.
"""

import re

import pandas as pd

_MARKDOWN = re.compile(r"([\\`*_\[\]<>|&~])")
_FORMULA = re.compile(r"[=+\-@\t\r].", re.DOTALL)


def terminal(text: object) -> str:
    """`text` in one line of what prints; everything else is written out, an escape as `\\x1b`."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in str(text)
    )


def terminal_lines(text: object) -> str:
    """The same for a text whose lines are to stay lines."""
    return "\n".join(map(terminal, str(text).split("\n")))


def markdown(text: object) -> str:
    """`text` for a line of Markdown: no HTML, link, image or cell of a table."""
    return _MARKDOWN.sub(r"\\\1", " ".join(str(text).split()))


def code(text: object) -> str:
    """`text` as code in a line or a table's cell of Markdown."""
    words = " ".join(str(text).split()).replace("|", "\\|")
    ticks = "`" * (_longest_ticks(words) + 1)
    space = " " if "`" in words else ""
    return f"{ticks}{space}{words}{space}{ticks}"


def fenced(text: str, language: str) -> str:
    """`text` as a block of code in Markdown, which nothing in it can end."""
    ticks = "`" * max(_longest_ticks(text) + 1, 3)
    return f"{ticks}{language}\n{text}\n{ticks}\n"


def cell(value: object) -> object:
    """A value for CSV: no spreadsheet takes a text for a formula, numbers are numbers."""
    if isinstance(value, str) and _FORMULA.match(value) and not _is_number(value):
        return f"'{value}"
    return value


def as_csv(table: pd.DataFrame) -> str:
    """A table as CSV, in whose names and texts no spreadsheet finds a formula."""
    texts = table.select_dtypes(exclude="number")
    safe = table.assign(**{str(name): texts[name].map(cell) for name in texts})
    return safe.rename(columns=cell).to_csv(index=False, lineterminator="\n")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _longest_ticks(text: str) -> int:
    return max((len(found) for found in re.findall("`+", text)), default=0)
