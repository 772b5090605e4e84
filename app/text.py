"""Text from a run's files, escaped for display."""

import html
import math
import re

from tom.harmless import unlinked

DIGITS = 12
"""maximum number of digits of a number in an address"""
_MARKDOWN = re.compile(r"([\\`*_{}\[\]()#+\-.!|~$:<>&])")


def markdown(text: object) -> str:
    """`text` for a Markdown field, shown literally, without links, images, HTML or icons."""
    return _MARKDOWN.sub(r"\\\1", unlinked(" ".join(str(text).split())))


def plotly(text: object) -> str:
    """`text` for Plotly, whose labels accept some HTML."""
    return html.escape(" ".join(str(text).split()))


def whole(words: object) -> int | None:
    """The whole number that an address or a name holds in digits; None if it holds none."""
    digits = str(words)
    # Not `isdigit`, which takes a superscript; Python refuses to read thousands of digits.
    return int(digits) if digits.isdecimal() and len(digits) <= DIGITS else None


def number(value: float | None, digits: int = 1) -> str:
    """A number as text; a dash for None."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.{digits}f}"


def score(value: float | None) -> str:
    """A return as text, with three digits if it is less than 1; a dash for None."""
    if value is None or not math.isfinite(value) or value == 0 or abs(value) >= 1:
        return number(value)
    return short(value)


def short(value: float) -> str:
    """A measure with three digits; a dash if it is not finite."""
    return f"{value:.3g}" if math.isfinite(value) else "-"


def duration(seconds: float | None) -> str:
    """`75` -> `1 min 15 s`; a dash if it is unknown."""
    if seconds is None or not math.isfinite(seconds) or seconds < 0:
        return "-"
    whole = round(seconds)
    hours, minutes = divmod(whole // 60, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {whole % 60:02d} s" if minutes else f"{whole} s"
