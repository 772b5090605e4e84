"""The verdicts on the studies that are listed, by the rules of `tom.studies`."""

from collections.abc import Sequence
from contextlib import suppress

from app.data import studies
from app.data.studies import Study
from tom.studies import STUDIES, load, two_axes
from tom.studies.verdicts import Tables, Verdict, verdict_of


def tables_of(study: Study) -> Tables:
    read = ((path.stem, studies.table(path)) for path in study.tables)
    return {
        name: [dict(row) for row in table.to_dict("records")]
        for name, table in read
        if table is not None
    }


def verdict(study: Study) -> Verdict | None:
    """The verdict on a study's question; None without a rule for it, or without its tables."""
    return verdict_of(load(study.verb), tables_of(study)) if study.verb in STUDIES else None


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
            near, errs = (tables_of(by_verb[name])["moments"] for name in ("footprint", "capacity"))
            found[by_verb["capacity"].name] = two_axes.verdict(near, errs)
    return found
