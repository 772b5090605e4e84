"""Text on pages: what comes from a run's files, escaped, and links to the glossary."""

import html
import re
from pathlib import Path

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


def parse_int(value: object) -> int | None:
    """The whole number that an address or a name holds in digits; None if it holds none."""
    digits = str(value)
    # Not `isdigit`, which takes a superscript; Python refuses to read thousands of digits.
    return int(digits) if digits.isdecimal() and len(digits) <= DIGITS else None


# The glossary: docs/glossary.md, which a clone has.

GLOSSARY = Path(__file__).parents[1] / "docs" / "glossary.md"
GLOSSARY_PATH = "glossary"
LINKED = {
    "effective sample": "ess", "footprint": "footprint", "exams": "exam", "exam": "exam",
    "snapshot": "snapshot", "as printed": "as printed", "replay buffer": "replay buffer",
    "ghost": "ghost", "corrected": "corrected", "moments": "moment",
}  # fmt: skip
"""words that a page links, and their terms in the glossary; common ones, such as `run`, are not"""
_ENTRY = re.compile(r"- \*\*(.+?)\*\*: ((?:.|\n(?!- ))+)")
_WORD = re.compile(rf"(?<![\w/\[])({'|'.join(LINKED)})(?![\w/\]])", re.IGNORECASE)


def with_glossary_links(markdown: str) -> str:
    """The Markdown text with a link where each of `LINKED` stands first."""
    if not GLOSSARY.is_file():
        return markdown
    seen: set[str] = set()

    def link(found: re.Match[str]) -> str:
        term = LINKED[found[0].lower()]
        if term in seen:
            return found[0]
        seen.add(term)
        return f"[{found[0]}]({GLOSSARY_PATH}#{anchor(term)})"

    return _WORD.sub(link, markdown)


def anchor(term: str) -> str:
    """The name of a term's place on the glossary's page."""
    return re.sub(r"\W+", "-", term.lower()).strip("-")


def terms() -> dict[str, str]:
    """The meaning of each term, in the order of the file; empty without the file."""
    if not GLOSSARY.is_file():
        return {}
    found = _ENTRY.findall(GLOSSARY.read_text())
    return {term.replace("`", ""): " ".join(meaning.split()) for term, meaning in found}


def glossary() -> str:
    """The glossary as HTML, with an anchor for each term."""
    entries = "".join(
        f'<dt id="{anchor(term)}"><b>{html.escape(term)}</b></dt><dd>{html.escape(meaning)}</dd>'
        for term, meaning in terms().items()
    )
    style = (
        ":root{color-scheme:light dark} body{font:16px/1.5 system-ui,sans-serif;max-width:40rem;"
        "margin:2rem auto;padding:0 1rem} dd{margin:0 0 .8rem} dt:target{outline:2px solid}"
    )
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Glossary - TOM Studio'
        f"</title><style>{style}</style></head><body><h1>Glossary</h1><dl>{entries}</dl></body></html>"
    )
