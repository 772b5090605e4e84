"""`tom reproduce progression`: the weight progression on an ordered buffer."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict

from tom.cli.reproduce.study import (
    Distinct,
    add_output,
    add_recordings,
    check_recordings,
    out_folder,
    print_json,
    sac_recordings,
    say,
    stoppable,
    tasks,
)
from tom.cli.tables import show
from tom.errors import unknown
from tom.record import Store
from tom.reports.origin import seeds as in_short
from tom.studies import progression_files, verdicts
from tom.studies.each import each
from tom.studies.progression import Finding, Result, cases, checks, result
from tom.studies.report import write_study

PRESETS = ("exact", "paper")
CLAIM = (
    "On a buffer whose first half is random and whose second half is SAC's training in order, "
    "TOM's weights for the trained policy are low on the random half and rise towards the end; "
    "they start to rise earlier than recency would have it, sometimes non-monotonically (5.2)."
)
CAPTION = "Mean weight along the ordered buffer, single seeds faint"


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "progression",
        help="weights along an ordered replay buffer",
        description="Record SAC where the store has no such recording, weigh every recording for "
        "its own policy, for the random policy and with its rows shuffled, and hold the profiles "
        "against the acceptance. Median over TOM's seeds; the first preset is judged.",
    )
    add_recordings(parser)
    parser.add_argument(
        "--sac-seeds", nargs="+", type=int, action=Distinct, help="of recordings [as accepted]"
    )
    parser.add_argument(
        "--preset", nargs="+", action=Distinct, default=list(PRESETS), help="TOM's [exact paper]"
    )
    add_output(parser, "progression")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    for preset in args.preset:
        if preset not in PRESETS:
            raise unknown("preset", preset, PRESETS)
    check_recordings(args)
    envs = tasks(args.env)
    out_folder(args.out)
    runs = sac_recordings(Store(args.store), envs, args.sac_seeds, args.steps)
    asked = cases(runs, args.preset, args.seeds)
    done: list[Result] = []
    for one in each(result, asked, args.jobs, args.out):
        progression_files.keep_weights(args.out, one)
        done.append(one)
        say(f"{one.recording}: TOM {one.preset}, {one.condition}")
    findings = checks(done)
    progression_files.write(args.out, done, findings, args.preset[0])
    said = verdicts.progression([c for c in findings if c.preset == args.preset[0]])
    _report(findings, said, args)
    _print(findings, said, args)
    return 0 if all(c.met is not False for c in findings if c.preset == args.preset[0]) else 1


def _report(findings: Sequence[Finding], said: Sequence[str], args: argparse.Namespace) -> None:
    rows = [
        {
            "name": f"{c.recording}, {c.condition} policy, {c.learner}, {c.quantity}",
            "preset": c.preset,
            "median": c.median,
            "by seed": " ".join(f"{value:.3g}" for value in c.values),
            "bound": "" if c.bound is None else f"{c.bound[0]} {c.bound[1]:g}",
            "met": c.met if c.preset == args.preset[0] else None,
        }
        for c in findings
    ]
    drawn = [(CAPTION, args.out / f"{progression_files.FIGURE}.png")]
    used = in_short(args.seeds)
    recordings = len({c.recording for c in findings})
    n = f"{recordings} recordings, {len(args.seeds)} seeds of TOM on each"
    write_study(args.out, "Weight progression", CLAIM, said, rows, drawn, n=n, seeds=used)


def _print(findings: Sequence[Finding], said: Sequence[str], args: argparse.Namespace) -> None:
    if args.json:
        rows = [{**asdict(c), "median": c.median, "met": c.met} for c in findings]
        print_json({"checks": rows, "verdict": said, "out": str(args.out)})
        return
    titles, *rows = progression_files.table(findings)
    plain_rows = [[cell.replace("**", "") for cell in row] for row in rows]
    show("Weight progression: median over TOM's seeds (by seed)", titles, plain_rows)
    print("\n".join([*said, str(args.out)]))
