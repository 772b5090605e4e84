"""A report: one self-contained HTML page, its text as JSON, the rows behind it, and its origin."""

import base64
import csv
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from tom import readable
from tom.harmless import cell
from tom.record import RunReader
from tom.record.files import replace
from tom.record.versions import command, git_commit, machine, versions

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


def write_report(
    folder: Path,
    title: str,
    claim: str,
    findings: Sequence[str],
    figures: Sequence[tuple[str, Path]] = (),
    tables: Sequence[tuple[str, Rows]] = (),
    origin: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write `report.html` and its words, `report.json`, into `folder`.

    `claim` is the paper's, `figures` are (caption, path of a PNG), `tables` (title, rows), `origin`
    is how it was made.
    """
    head = html.escape(title)
    parts = [
        f'<meta charset="utf-8"><title>{head}</title><style>{STYLE}</style></head><body>',
        f"<h1>{head}</h1>",
        "<h2>What the paper says</h2>",
        f"<blockquote>{html.escape(claim)}</blockquote>",
        "<h2>What was found here</h2>",
        *(f"<p>{html.escape(line)}</p>" for line in findings),
    ]
    for caption, path in figures:
        image, text = base64.b64encode(path.read_bytes()).decode(), html.escape(caption)
        image = f'<img alt="{text}" src="data:image/png;base64,{image}">'
        parts.append(f"<figure>{image}<figcaption>{text}</figcaption></figure>")
    made = [{"what": name, "value": value} for name, value in origin.items()]
    for name, rows in (*tables, ("How it was made", made)):
        parts += [f"<h2>{html.escape(name)}</h2>", _table(rows)]
    page = "\n".join(["<!doctype html><html><head>", *parts, "</body></html>\n"])
    words = {"title": title, "claim": claim, "found": findings, "origin": dict(origin)}
    for name, text in ((WORDS, json.dumps(words, indent=1) + "\n"), (NAME, page)):
        replace(folder / name, lambda file, text=text: file.write(text.encode()), sync=False)


def _table(rows: Rows) -> str:
    if not rows:
        return "<p>nothing</p>"
    lines = (
        [f"<th>{html.escape(name)}</th>" for name in rows[0]],
        *(
            [f"<td>{html.escape(readable.cell(value))}</td>" for value in row.values()]
            for row in rows
        ),
    )
    body = "".join(f"<tr>{''.join(line)}</tr>" for line in lines)
    return f'<div class="scroll"><table>{body}</table></div>'


def write_csv(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """One line for each row, the first row's keys as the titles; no rows, an empty file."""
    listed = list(rows)
    with path.open("w", newline="") as file:
        if listed:
            writer = csv.DictWriter(file, list(listed[0]))
            writer.writerow({name: cell(name) for name in listed[0]})
            writer.writerows({name: cell(value) for name, value in row.items()} for row in listed)


def read_csv(path: Path) -> pd.DataFrame | None:
    """The rows of a table; None if there are none, or it cannot be read."""
    try:
        return pd.read_csv(path)
    except (OSError, ValueError):  # pandas raises ValueError for a damaged file
        return None


def read_tables(paths: Iterable[Path]) -> dict[str, list[dict[str, Any]]]:
    """The rows of the tables that can be read, by the files' names."""
    read = ((path.stem, read_csv(path)) for path in paths)
    return {
        name: [
            {str(column): value for column, value in row.items()}
            for row in table.to_dict("records")
        ]
        for name, table in read
        if table is not None
    }


def origin() -> dict[str, str]:
    """Command, time, commit, versions and machine of this process."""
    kind = machine()
    return {
        "command": command(),
        "made": datetime.now(UTC).isoformat(" ", "minutes"),
        "commit of the report": git_commit() or "unknown",
        "versions": ", ".join(f"{name} {text}" for name, text in versions().items()),
        "machine": f"{kind['cpu']}, {kind['cores']} cores",
    }


def origin_of_runs(runs: Sequence[RunReader]) -> dict[str, str]:
    """The runs that were read: number, hours, commits, versions, seeds."""
    commits = sorted({str(run.config.get("git_commit"))[:19] for run in runs})
    torches = sorted({str(run.config.get("versions", {}).get("torch")) for run in runs})
    return {
        "runs": str(len(runs)),
        "hours of training": f"{sum(map(run_hours, runs)):.1f}",
        "commits of the runs": ", ".join(commits),
        "torch of the runs": ", ".join(torches),
        "seeds": in_short([run.seed for run in runs]),
    }


def run_hours(run: RunReader) -> float:
    """Wall-clock hours of a training, from its metrics."""
    table = run.metrics()
    if "time/wall_s" not in table:
        return 0.0
    seconds = table["time/wall_s"].dropna().to_numpy()
    return float(seconds.max(initial=0.0)) / 3600


def in_short(numbers: Sequence[int]) -> str:
    """Seeds as text with ranges: `0-3, 7`."""
    ranges = []
    for _, group in groupby(enumerate(sorted(set(numbers))), lambda pair: pair[1] - pair[0]):
        members = [seed for _, seed in group]
        ranges.append(f"{members[0]}-{members[-1]}" if len(members) > 1 else str(members[0]))
    return ", ".join(ranges)
