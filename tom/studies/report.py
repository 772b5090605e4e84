"""The report of a study with an acceptance: claim, figures, and the result of each check."""

import time
from collections.abc import Sequence
from pathlib import Path

from tom.reports.html import Report, Rows, write_report
from tom.reports.origin import origin

_BEGUN = time.monotonic()  # a study is a separate process


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
    """Write `report.html`: `checks` are rows with `name` and `met` (None without a bound).

    `verdict` compares the result with the paper's `claim`, `checks` with our own acceptance.
    `details` are added to the origin, such as n and seeds. The hours are those of this process.
    """
    judged = [row for row in checks if row["met"] is not None]
    failed = [str(row["name"]) for row in judged if not row["met"]]
    sentences = [
        *verdict,
        f"{len(judged) - len(failed)} of {len(judged)} figures of our acceptance are met.",
    ]
    if failed:
        sentences.append(f"Not met: {'; '.join(failed)}.")
    shown = [{**row, "met": {True: "yes", False: "NO", None: ""}[row["met"]]} for row in checks]  # pyright: ignore[reportArgumentType]
    tables = [("Acceptance", shown), *tables]
    return write_report(
        Report(title, claim, sentences, figures, tables, study_origin(**details)), folder
    )


def study_origin(**details: str) -> dict[str, str]:
    """The origin of a study, with `details` such as n and seeds."""
    hours = (time.monotonic() - _BEGUN) / 3600
    return (
        origin() | {"hours": f"{hours:.2f} (cases kept from an earlier call not counted)"} | details
    )
