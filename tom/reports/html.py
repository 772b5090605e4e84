"""A report as a self-contained HTML file with figures, tables and origin.

Its text, without figures and tables, is also written as JSON.
"""

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tom import readable
from tom.record.files import replace

NAME = "report.html"
WORDS = "report.json"
Rows = Sequence[Mapping[str, object]]

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2330; max-width: 62rem;
       margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
img { max-width: 100%; } figure { margin: 1rem 0; } figcaption { color: #566; }
table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .2rem .7rem .2rem 0; border-bottom: 1px solid #dde; text-align: left; }
.scroll { overflow-x: auto; } blockquote { margin: 0; color: #566; }
"""


@dataclass(frozen=True)
class Report:
    """The content of a report: the paper's `claim`, the findings, and the origin.

    `figures` are (caption, path of a PNG), `tables` (title, rows); `origin` is command, commit and
    versions.
    """

    title: str
    claim: str
    findings: Sequence[str]
    figures: Sequence[tuple[str, Path]] = ()
    tables: Sequence[tuple[str, Rows]] = ()
    origin: Mapping[str, str] = field(default_factory=dict)


def write_report(report: Report, folder: Path) -> Path:
    """Write `report.html` and `report.json` into `folder` and return the path of the first."""
    title = html.escape(report.title)
    parts = [
        f"<h1>{title}</h1>",
        "<h2>What the paper says</h2>",
        f"<blockquote>{html.escape(report.claim)}</blockquote>",
        "<h2>What was found here</h2>",
        *(f"<p>{html.escape(line)}</p>" for line in report.findings),
        *(_figure(caption, path) for caption, path in report.figures),
        *(f"<h2>{html.escape(name)}</h2>{_table(rows)}" for name, rows in report.tables),
        "<h2>How it was made</h2>",
        _table([{"what": name, "value": value} for name, value in report.origin.items()]),
    ]
    head = f'<meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    body = "\n".join(parts)
    path = folder / NAME
    words = {
        "title": report.title,
        "claim": report.claim,
        "found": report.findings,
        "origin": report.origin,
    }
    page = f"<!doctype html><html><head>{head}</head><body>\n{body}\n</body></html>\n"
    for name, text in ((WORDS, json.dumps(words, indent=1) + "\n"), (NAME, page)):
        replace(folder / name, lambda file, text=text: file.write(text.encode()), sync=False)
    return path


def _figure(caption: str, path: Path) -> str:
    content = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(caption)
    image = f'<img alt="{text}" src="data:image/png;base64,{content}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def _table(rows: Rows) -> str:
    if not rows:
        return "<p>nothing</p>"
    titles = "".join(f"<th>{html.escape(name)}</th>" for name in rows[0])
    lines = "".join(f"<tr>{''.join(map(_cell, row.values()))}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{titles}</tr>{lines}</table></div>'


def _cell(value: object) -> str:
    return f"<td>{html.escape(readable.cell(value))}</td>"
