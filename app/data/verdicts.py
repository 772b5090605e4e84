"""The verdicts on the studies that are listed, by the rules of `tom.studies`."""

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
    by_ending: dict[str, dict[str, Study]] = {}
    for study in listed:
        by_ending.setdefault(study.name.removeprefix(study.verb), {}).setdefault(study.verb, study)
    found = {}
    for by_verb in by_ending.values():
        with suppress(KeyError, ValueError):  # one is not computed, or tables of another version
            near, errs = (by_verb[verb] for verb in ("footprint", "capacity"))
            moments = (read_tables(study.tables)["moments"] for study in (near, errs))
            found[errs.name] = two_axes.verdict(*moments)
    return found
