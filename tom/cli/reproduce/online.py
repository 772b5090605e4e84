"""`tom reproduce online`: weight profiles over the buffer at several steps of a run."""

import argparse
from pathlib import Path

from tom.cli.reproduce.study import (
    add_output,
    add_stored,
    check_stored,
    out_folder,
    print_json,
    stoppable,
)
from tom.cli.tables import cell, show
from tom.errors import UserError
from tom.record import Store
from tom.reports.files import write_csv
from tom.reports.html import Report, write_report
from tom.reports.origin import origin_of, seeds
from tom.reports.style import save
from tom.studies import online as study
from tom.studies.online_figure import online_figure

CLAIM = (
    "TOM's weights are not high only at the very end of the replay buffer, where data is nearly "
    "optimal: it often pays attention to transitions that were collected at earlier stages, as for "
    "Hopper at step 120 000 and Walker2d at 200 000 (appendix, online progression)."
)
CAPTION = "Mean weight in each hundredth of the replay buffer, oldest transitions first."
COLUMNS = ("env", "learner", "seed", "step", "newest tenth", "peak at", "ess")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "online",
        help="weight profiles over the buffer at several steps of a run, each environment",
        description="Draw where the weights lie in the replay buffer at several fits of the "
        "longest run of each environment and learner that the store has. Nothing is trained.",
    )
    add_stored(parser)
    add_output(parser, "online")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    envs = check_stored(args)
    runs = [run for run in Store(args.store).runs() if run.env in envs]
    profiles = study.panels(runs, *args.preset)
    if not profiles:
        raise UserError(
            f"{args.store}/ has no such run that weighed its buffer: tom sweep --env "
            f"{' '.join(envs)} --learner tom pmac vagram --preset {args.preset[0]} makes them"
        )
    out_folder(args.out)
    rows, said = study.rows(profiles), study.verdict(profiles)
    _write(args.out, profiles, rows, said)
    if args.json:
        print_json({"rows": rows, "verdict": said})
        return 0
    cells = [[cell(row[name]) for name in COLUMNS] for row in rows]
    show("Where the weights lie: share on the newest tenth, position of the peak", COLUMNS, cells)
    print("\n".join([*said, str(args.out)]))
    return 0


def _write(out: Path, panels: list[study.RunProfiles], rows: list[dict], said: list[str]) -> None:
    profiles = (
        {"env": p.run.env, "learner": p.run.learner, "run": p.run.run_id, "step": int(step),
         "bin": number, "mean_weight": weight}
        for p in panels
        for step, bins in zip(p.env_step, p.bins, strict=True)
        for number, weight in enumerate(bins.tolist())
    )  # fmt: skip
    write_csv(out / "profiles.csv", profiles)
    write_csv(out / "online.csv", rows)
    png, _ = save(online_figure(panels), out, "online")
    runs = [panel.run for panel in panels]
    made = origin_of(runs) | {"seeds": seeds([run.seed for run in runs])}
    tables = [("Every profile", rows)]
    report = Report("Weights as a run goes on", CLAIM, said, [(CAPTION, png)], tables, made)
    write_report(report, out)
