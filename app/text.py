"""Text from a run's files, escaped for display."""

import html
import re

from tom.harmless import unlinked

DIGITS = 12
"""maximum number of digits of a number in an address"""
_UNIT = re.compile(r"(?<=\d) (?=(?:%|ms|s|min|h|kB|MB|GB)(?!\w))")
_MARKDOWN = re.compile(r"([\\`*_{}\[\]()#+\-.!|~$:<>&])")


def unbroken(sentence: str) -> str:
    """The sentence with numbers that stay beside their unit at the end of a line."""
    return _UNIT.sub("\u00a0", sentence)


def markdown(text: object) -> str:
    """`text` for a Markdown field, shown literally, without links, images, HTML or icons."""
    return _MARKDOWN.sub(r"\\\1", unlinked(unbroken(" ".join(str(text).split()))))


def plotly(text: object) -> str:
    """`text` for Plotly, whose labels accept some HTML."""
    return html.escape(" ".join(str(text).split()))


def whole(words: object) -> int | None:
    """The whole number that an address or a name holds in digits; None if it holds none."""
    digits = str(words)
    # Not `isdigit`, which takes a superscript; Python refuses to read thousands of digits.
    return int(digits) if digits.isdecimal() and len(digits) <= DIGITS else None
