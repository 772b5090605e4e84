"""The files of the weight progression study: weights, profiles, checks and the figure."""

import csv
from collections.abc import Sequence
from pathlib import Path

from tom.data.sampling import bin_means
from tom.learners import LEARNERS
from tom.reports.profile_figure import Panel, profile_figure
from tom.reports.style import save
from tom.reports.weighing_files import profiles, write_weights
from tom.studies.progression import Finding, Result

BINS = 100
FIGURE = "progression"
TITLES = {
    ("own", "tom"): "TOM, its trained policy",
    ("random", "tom"): "TOM, the random policy",
    ("shuffled", "tom"): "TOM, rows shuffled",
    ("own", "pmac"): "PMAC",
    ("shuffled", "pmac"): "PMAC, rows shuffled",
}


def keep_weights(folder: Path, case: Result) -> None:
    """Write all single weights of `case`."""
    name = f"{case.recording}-{case.condition}-{case.preset}.parquet"
    write_weights(folder / name, case.weighed)


def write(folder: Path, done: Sequence[Result], findings: Sequence[Finding], preset: str) -> None:
    """Write `profiles.csv`, `checks.csv`, `checks.md` and the figure of TOM's `preset`."""
    _write_profiles(folder / "profiles.csv", done)
    _write_table(folder, table(findings))
    by_recording: dict[str, dict[tuple[str, str], Result]] = {}
    for case in done:
        if case.preset == preset:
            of = by_recording.setdefault(case.recording, {})
            of |= {(case.condition, learner): case for learner in ("tom", "pmac")}
    panels = {
        name: [
            Panel(title, learner, profiles(of[condition, learner].of(learner), BINS))
            for (condition, learner), title in TITLES.items()
        ]
        for name, of in by_recording.items()
    }
    shares = {c.recording: c.ordered_from / len(c.weighed[0].weights) for c in done}
    save(profile_figure(panels, shares), folder, FIGURE)


def table(findings: Sequence[Finding]) -> list[list[str]]:
    """The checks as rows of text, titles first, with TOM's presets side by side."""
    presets = list(dict.fromkeys(c.preset for c in findings))
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for c in findings:
        if c.learner == "pmac" and c.preset != presets[0]:
            continue  # PMAC has no preset
        bound = "" if c.bound is None else f"{c.bound[0]} {c.bound[1]:g}"
        key = (c.recording, c.condition, LEARNERS[c.learner].label, c.quantity, bound)
        lines.setdefault(key, {})[c.preset] = _value(c)
    titles = ["recording", "policy", "learner", "quantity", "bound", *presets]
    return [titles, *([*key, *(of.get(p, "") for p in presets)] for key, of in lines.items())]


def _value(c: Finding) -> str:
    by_seed = " ".join(f"{v:.3g}" for v in c.values)
    verdict = {None: "", True: " yes", False: " **no**"}[c.met]
    return f"{c.median:.3g} ({by_seed}){verdict}"


def _write_table(folder: Path, rows: Sequence[Sequence[str]]) -> None:
    with (folder / "checks.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    titles, *rest = (f"| {' | '.join(row)} |" for row in rows)
    rule = "|" + "---|" * len(rows[0])
    (folder / "checks.md").write_text("\n".join([titles, rule, *rest]) + "\n")


def _write_profiles(path: Path, done: Sequence[Result]) -> None:
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["recording", "preset", "policy", "learner", "seed", "bin", "mean_weight"])
        for case in done:
            for one in case.weighed:
                key = [case.recording, case.preset, case.condition, one.learner, one.seed]
                for number, mean in enumerate(bin_means(one.weights, BINS).tolist()):
                    lines.writerow([*key, number, f"{mean:.6g}"])
