"""Links from words on a page to docs/glossary.md, which a clone has."""

import html
import re
from pathlib import Path

FILE = Path(__file__).parents[1] / "docs" / "glossary.md"
PATH = "glossary"
WORDS = {
    "effective sample": "ess", "footprint": "footprint", "exams": "exam", "exam": "exam",
    "snapshot": "snapshot", "as printed": "as printed", "replay buffer": "replay buffer",
    "ghost": "ghost", "corrected": "corrected", "moments": "moment",
}  # fmt: skip
"""words that a page links, and their terms in the glossary; common ones, such as `run`, are not"""
_ENTRY = re.compile(r"- \*\*(.+?)\*\*: ((?:.|\n(?!- ))+)")
_WORD = re.compile(rf"(?<![\w/\[])({'|'.join(WORDS)})(?![\w/\]])", re.IGNORECASE)


def linked(markdown: str) -> str:
    """The Markdown text with a link where each of `WORDS` stands first."""
    if not FILE.is_file():
        return markdown
    seen: set[str] = set()

    def link(found: re.Match[str]) -> str:
        term = WORDS[found[0].lower()]
        if term in seen:
            return found[0]
        seen.add(term)
        return f"[{found[0]}]({PATH}#{anchor(term)})"

    return _WORD.sub(link, markdown)


def anchor(term: str) -> str:
    """The name of a term's place on the glossary's page."""
    return re.sub(r"\W+", "-", term.lower()).strip("-")


def terms() -> dict[str, str]:
    """The meaning of each term, in the order of the file; empty without the file."""
    if not FILE.is_file():
        return {}
    found = _ENTRY.findall(FILE.read_text())
    return {term.replace("`", ""): " ".join(meaning.split()) for term, meaning in found}


def page() -> str:
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
