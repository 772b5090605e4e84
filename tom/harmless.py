"""Text from a run's files, escaped for the place where it is written.

Settings, notes, names and error texts cannot be trusted: a store may be a copy from elsewhere.
"""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

_MARKDOWN = re.compile(r"([\\`*_\[\]<>|&~])")
_ADDRESS = re.compile(r"(https?:|www|@)(?=[/.\w])", re.IGNORECASE)
_FORMULA = re.compile(r"[=+\-@\t\r].", re.DOTALL)


def terminal(text: object) -> str:
    """`text` as one line of printable characters; others are written as escapes such as `\\x1b`."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in str(text)
    )


def markdown(text: object) -> str:
    """`text` for a line of Markdown, without HTML, links, images or table cells."""
    return _MARKDOWN.sub(r"\\\1", unlinked(" ".join(str(text).split())))


def unlinked(text: str) -> str:
    """`text` with invisible word joiners where Markdown would make a link of a bare address.

    A backslash does not help: addresses are looked for after it has been taken out.
    """
    return _ADDRESS.sub("\\1\u2060", text)


def code(text: object) -> str:
    """`text` as inline code in Markdown, also in a table's cell."""
    words = " ".join(str(text).split()).replace("|", "\\|")
    ticks = "`" * (_longest_ticks(words) + 1)
    space = " " if "`" in words else ""
    return f"{ticks}{space}{words}{space}{ticks}"


def fenced(text: str, language: str) -> str:
    """`text` as a code block in Markdown that its content cannot close."""
    ticks = "`" * max(_longest_ticks(text) + 1, 3)
    return f"{ticks}{language}\n{text}\n{ticks}\n"


def cell(value: object) -> object:
    """A value for CSV: texts cannot become spreadsheet formulas, numbers stay numbers."""
    if isinstance(value, str) and _FORMULA.match(value) and not is_number(value):
        return f"'{value}"
    return value


def as_csv(table: "pd.DataFrame") -> str:
    """A table as CSV whose names and texts cannot become spreadsheet formulas."""
    texts = table.select_dtypes(exclude="number")
    safe = table.assign(**{str(name): texts[name].map(cell) for name in texts})
    return safe.rename(columns=cell).to_csv(index=False, lineterminator="\n")


def is_number(text: str) -> bool:
    """Whether Python reads the text as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _longest_ticks(text: str) -> int:
    return max((len(ticks) for ticks in re.findall("`+", text)), default=0)
