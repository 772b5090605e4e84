"""The page on how the small copies in a store were made, written by `tom runs index`."""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from tom import readable
from tom.analysis.settings import variants
from tom.errors import UserError
from tom.harmless import code, fenced, markdown
from tom.learners import LEARNERS, learner_rank
from tom.record import RunReader, Store
from tom.record.files import read_json, replace
from tom.record.thin import without_options
from tom.reports.report import in_short, run_hours
from tom.reports.weighing_files import REPORT, of_run

NAME = "README.md"
COMMIT = 10  # characters shown of a commit
WHERE = ("--store", "--run-id", "--no-rerun", "--out")
"""options that set where a result goes, not what it is"""
FLAGS = ("--no-rerun",)
"""those of them that have no value"""
MARK = "This page was written by `tom runs index`."
"""part of every such page; a page without it was written by a person"""
HEAD = f"""# Gallery

Small copies of real runs, one folder each (`docs/run-folder.md`): `tom studio` and `tom runs` show
them like any other run. What was left out stands in each `config.json` under `thinned`. Hours are
wall-clock hours of one process, as the run recorded them, whatever else the machine did meanwhile.
{MARK}
"""


def small_copies(store: Store) -> list[RunReader]:
    """The small copies in a store, by task, learner and seed."""
    runs = [run for run in store.runs() if run.small_copy]
    return sorted(runs, key=lambda run: (run.env, learner_rank(run.learner), run.seed, run.run_id))


def index(runs: Sequence[RunReader], weighings: Sequence[Path]) -> str:
    """The page for these small copies and weighings of their buffers."""
    parts, settings = [HEAD], variants(runs)
    for env, group in groupby(runs, key=lambda run: run.env):
        of = list(group)
        rows = [_row(run, settings[run.run_id]) for run in of]
        parts += _section(env, rows, [run.config for run in of])
    if weighings:
        reports = [read_json(path / REPORT) for path in weighings]
        made = [report.get("made", {}) for report in reports]
        parts += _section("Weighings", map(_weighing, weighings, reports), made)
    return "\n".join(parts)


def write(store: Store) -> Path:
    """Write the page about a store into it, atomically; its path.

    Raises UserError if there are no small copies, or the page there was written by a person, or it
    cannot be written.
    """
    runs, path = small_copies(store), store.path / NAME
    if not runs:
        raise UserError(f"{store.path}/ has no small copies: tom runs export --small makes them")
    page = index(runs, [path for run in runs for path in of_run(store.path, run.run_id)])
    try:
        held = path.read_text(errors="replace") if path.exists() else MARK
        if MARK not in held:
            raise UserError(
                f"{path} was not written by this command: move it away, or write the line "
                f"'{MARK}' into it to have it replaced"
            )
        replace(path, lambda file: file.write(page.encode()), sync=False)
    except OSError as error:
        raise UserError(
            f"cannot write {path} ({error.strerror}): make its folder writable, or move it away"
        ) from error
    return path


def _row(run: RunReader, settings: str) -> dict[str, str]:
    """The row of a run; `settings` in which it differs from others of its preset, in words."""
    status, config = run.status, run.config
    trained = (made.get("git_commit") for made in (config, *config.get("resumes", ())))
    return {
        "run": code(run.run_id),
        "learner": _label(run.learner),
        "preset": markdown(", ".join(filter(None, [run.preset, settings]))),
        "seed": str(run.seed),
        "steps": f"{status.env_step:,}",
        "final return": readable.score(status.last_return),
        "best return": readable.score(status.best_return),
        "hours": f"{run_hours(run):.2f}",
        "commit": ", ".join(dict.fromkeys(map(_commit, trained))),
    }


def _weighing(path: Path, report: Mapping[str, Any]) -> dict[str, str]:
    made, results = report.get("made", {}), report["results"]
    return {
        "weighing": code(path.name),
        "buffer of": code(report["data"]),
        "by the policy of": code(report["policy"]),
        "learners": ", ".join(dict.fromkeys(_label(row["learner"]) for row in results)),
        "seeds": in_short([row["seed"] for row in results]),
        "rows": f"{report['rows']:,}",
        "hours": f"{made['hours']:.2f}" if "hours" in made else "-",
        "commit": _commit(made.get("git_commit")),
    }


def _section(
    title: str, rows: Iterable[Mapping[str, str]], origins: Sequence[Mapping[str, Any]]
) -> list[str]:
    """A table, then the distinct commands, with the seed as N, and versions."""
    listed = list(rows)
    lines = [list(listed[0]), ["---"] * len(listed[0]), *(list(row.values()) for row in listed)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    commands = dict.fromkeys(short_command(str(made.get("command", ""))) for made in origins)
    versions = dict.fromkeys(
        ", ".join(f"{name} {text}" for name, text in made.get("versions", {}).items())
        for made in origins
    )
    block = fenced("\n".join(commands), "bash")
    made_with = f"Made with {markdown('; '.join(versions))}.\n"
    return [f"## {markdown(title)}\n", f"{table}\n", f"{block}\n{made_with}"]


def short_command(command: str) -> str:
    """A command with its seed as N and without the options for the result's place."""
    words = without_options(command, WHERE, FLAGS)
    words = [re.sub(r"^--seed=\d+$", "--seed=N", word) for word in words]
    return re.sub(r"(?<= --seed )\d+\b", "N", shlex.join(words))


def _commit(commit: object) -> str:
    text = str(commit or "unknown")
    return markdown(text[:COMMIT]) + ("-dirty" if text.endswith("-dirty") else "")


def _label(learner: str) -> str:
    return LEARNERS[learner].label if learner in LEARNERS else markdown(learner)
