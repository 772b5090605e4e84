"""What the weight progression study leaves behind: weights, profiles, checks and the figure."""

import csv
from collections.abc import Sequence
from pathlib import Path

from tom.data.sampling import bin_means
from tom.progression_study import Case, Check
from tom.reports.progression import Panel, profile_figure
from tom.reports.style import save
from tom.weighing_files import profiles, write_weights

BINS = 100
FIGURE = "progression"
TITLES = {
    ("own", "tom"): "TOM, its trained policy",
    ("random", "tom"): "TOM, the random policy",
    ("shuffled", "tom"): "TOM, rows shuffled",
    ("own", "pmac"): "PMAC",
    ("shuffled", "pmac"): "PMAC, rows shuffled",
}


def keep_weights(folder: Path, case: Case) -> None:
    """Write every single weight of `case`."""
    name = f"{case.recording}-{case.condition}-{case.preset}.parquet"
    write_weights(folder / name, case.found)


def write(folder: Path, done: Sequence[Case], found: Sequence[Check], preset: str) -> None:
    """Write `profiles.csv`, `checks.csv` and the figure of TOM's `preset`."""
    _write_profiles(folder / "profiles.csv", done)
    write_checks(folder / "checks.csv", found)
    by_recording: dict[str, dict[tuple[str, str], Case]] = {}
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
    shares = {c.recording: c.ordered_from / len(c.found[0].weights) for c in done}
    save(profile_figure(panels, shares), folder, FIGURE)


def write_checks(path: Path, found: Sequence[Check]) -> None:
    """The acceptance table as CSV."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(
            ["recording", "preset", "policy", "learner", "quantity", "median", "by_seed", "bound",
             "met"]
        )  # fmt: skip
        for c in found:
            bound = "" if c.bound is None else f"{c.bound[0]} {c.bound[1]:g}"
            met = {None: "", True: "yes", False: "no"}[c.met]
            by_seed = " ".join(f"{v:.4g}" for v in c.values)
            table.writerow(
                [c.recording, c.preset, c.condition, c.learner, c.quantity, f"{c.median:.4g}",
                 by_seed, bound, met]
            )  # fmt: skip


def _write_profiles(path: Path, done: Sequence[Case]) -> None:
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["recording", "preset", "policy", "learner", "seed", "bin", "mean_weight"])
        for case in done:
            for one in case.found:
                key = [case.recording, case.preset, case.condition, one.learner, one.seed]
                for number, mean in enumerate(bin_means(one.weights, BINS).tolist()):
                    table.writerow([*key, number, f"{mean:.6g}"])
