"""The report of a study that is held against an acceptance: claim, figures, what is met."""

import time
from collections.abc import Sequence
from pathlib import Path

from tom.reports.html import Report, Rows, write_report
from tom.reports.origin import origin

_BEGUN = time.monotonic()  # a study is a process of its own


def write_study(
    folder: Path,
    title: str,
    claim: str,
    verdict: Sequence[str],
    checks: Rows,
    figures: Sequence[tuple[str, Path]],
    tables: Sequence[tuple[str, Rows]] = (),
    **details: str,
) -> Path:
    """Write `report.html`: `checks` are rows with `name` and `met` (None where it is not judged).

    `verdict` holds the result against the paper's `claim`, `checks` against our own acceptance.
    `details` are added to the origin, such as n and seeds. The hours are those of this process.
    """
    judged = [row for row in checks if row["met"] is not None]
    failed = [str(row["name"]) for row in judged if not row["met"]]
    found = [
        *verdict,
        f"{len(judged) - len(failed)} of {len(judged)} figures of our acceptance are met.",
    ]
    if failed:
        found.append(f"Not met: {'; '.join(failed)}.")
    shown = [{**row, "met": {True: "yes", False: "NO", None: ""}[row["met"]]} for row in checks]  # pyright: ignore[reportArgumentType]
    tables = [("Acceptance", shown), *tables]
    return write_report(
        Report(title, claim, found, figures, tables, study_origin(**details)), folder
    )


def study_origin(**details: str) -> dict[str, str]:
    """What a study was made with; `details` are added, such as n and seeds."""
    hours = (time.monotonic() - _BEGUN) / 3600
    return (
        origin() | {"hours": f"{hours:.2f} (cases kept from an earlier call not counted)"} | details
    )
