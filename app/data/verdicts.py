"""The verdicts on the studies that are listed, by the rules of `tom.studies`.

Apart from `app.data.studies`, which the page server imports: these rules load torch.
"""

from collections.abc import Sequence
from contextlib import suppress

from app.data.studies import Study
from tom.reports.report import read_tables
from tom.studies import load, two_axes
from tom.studies.verdicts import Verdict, verdict_of


def verdict(study: Study) -> Verdict | None:
    """The verdict on a study's question; None without a rule for it, or without its tables."""
    return verdict_of(load(study.verb), read_tables(study.tables)) if study.question else None


def on_two_axes(listed: Sequence[Study]) -> dict[str, Verdict]:
    """Answers of `tom.studies.two_axes` by capacity study, with the footprint study of its ending.

    Without moments of both there is no answer.
    """
    by_ending = {(study.verb, study.name.removeprefix(study.verb)): study for study in listed}
    found = {}
    for (verb, ending), errs in by_ending.items():
        if verb == "capacity":
            with suppress(KeyError, ValueError):  # no such footprint study, or of another version
                both = by_ending["footprint", ending], errs
                moments = (read_tables(study.tables)["moments"] for study in both)
                found[errs.name] = two_axes.verdict(*moments)
    return found
