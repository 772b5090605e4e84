"""`tom reproduce returns`: return curves of every learner, from the runs in the store."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tom.analysis.scores import BEST, FINAL, HEIGHT
from tom.analysis.statistics import RANKED
from tom.cli.parser import DIGITS, seed_number, whole_number
from tom.cli.reproduce.study import (
    add_output,
    add_stored,
    check_stored,
    out_folder,
    print_json,
    stoppable,
)
from tom.cli.tables import show
from tom.envs import task
from tom.errors import UserError, unknown
from tom.learners import LEARNERS
from tom.record import RunReader, Store
from tom.reports.files import write_csv
from tom.reports.html import Report, write_report
from tom.reports.origin import origin_of, seeds
from tom.reports.style import save
from tom.studies import returns as study
from tom.studies import returns_factors, returns_fits, returns_tables, verdicts
from tom.studies.returns_figure import return_figure

CLAIM = (
    "TOM performs best in aggregate in four of five environments, in sample efficiency and in "
    "final return, with larger gains where dynamics are complex (Walker2d, HalfCheetah, Humanoid); "
    "4 seeds, running maximum of the mean of 10 test episodes (section 5.2)."
)
WINS = "How often a run of one learner beats one of another"
FACTORS = (
    "What weights in the model, and in the rollouts' starts, do for the return: each the mean over "
    "both levels of the other; p of all is corrected for the tests of this table"
)
EXAMS = "Exams: the median fit of each run, on new steps of its own policy; mean over runs"
ROLLOUTS = (
    "Rollouts: how often they fall over how often the policy does (median fit of each run), and "
    "the share of fits with a row that has a tenth of the weight; mean over runs"
)
LESS = (
    "How often a run of one learner has a smaller number in its exams and rollouts than one of "
    "another (errors of runs on steps of their own policies)"
)
FEW = 3
"""groups whose exams are compared on the screen even if nobody named them"""
BY = {"best": BEST, "last": FINAL, "area": HEIGHT}
CAPTION = "Best return so far: mean over seeds, 95 % bootstrap band, single seeds faint."


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "returns",
        help="return curves of all environments and learners, with the runs that there are",
        description="Draw the return curves of every environment and learner from the runs that "
        "the store has, compare learners at a step that all runs of an environment reach or at "
        "one fixed beforehand, and list what is missing. Nothing is trained: `tom sweep` makes the "
        "runs.",
    )
    add_stored(parser, several=True)
    parser.add_argument(
        "--learner", nargs="+", default=list(LEARNERS), metavar="LEARNER",
        help="ours, or a plug-in's [all]",
    )  # fmt: skip
    parser.add_argument(
        "--at", nargs="+", default=[], metavar="[ENV=]STEP",
        help="compare at this env step, in ENV alone if it is named, without the runs that end "
        "earlier [what all runs reach]",
    )  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type=seed_number, metavar="N", help="[all]")
    parser.add_argument(
        "--apart", action="store_true",
        help="runs with settings other than their preset's are learners of their own [of each "
        "learner and preset only the settings that most seeds share]",
    )  # fmt: skip
    parser.add_argument(
        "--groups", nargs="+", metavar="GROUP",
        help='compare these alone, called as in the tables (MLE, "TOM, mended") [all]',
    )  # fmt: skip
    parser.add_argument(
        "--by", nargs="+", choices=tuple(BY), default=list(BY), metavar="SCORE",
        help=f"compare by these alone, of {' '.join(BY)}; p is corrected for no others [all]",
    )  # fmt: skip
    add_output(parser, "returns")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    envs = check_stored(args)
    for learner in args.learner:
        if learner not in LEARNERS:
            raise unknown("learner", learner, tuple(LEARNERS))
    at = _steps(args.at, envs)
    every = [
        run for run in Store(args.store).runs() if run.env in envs and run.learner in args.learner
    ]
    whole, _ = study.select(every, *args.preset, apart=args.apart)
    if not whole:
        raise UserError(
            f"{args.store}/ has no such run with an evaluation: tom sweep --env {' '.join(envs)} "
            f"--learner {' '.join(args.learner)} --preset {args.preset[0]} "
            f"--seeds {' '.join(map(str, range(RANKED)))} makes them"
        )
    runs = _with_seeds(every, args.seeds)
    groups = args.groups and [_called(group, args.preset[0]) for group in args.groups]
    _check_groups(groups, study.labels(runs, *args.preset, apart=args.apart))
    cells, left_out = study.select(runs, *args.preset, at=at, apart=args.apart, groups=groups)
    if not cells:
        asked = {"--at": args.at, "--seeds": args.seeds, "--groups": args.groups}
        words = (f"{option} {' '.join(map(str, of))}" for option, of in asked.items() if of)
        raise UserError(
            f"{' '.join(words)}: no such run was evaluated there or later; the longest of all ends "
            f"at {max(cell.longest for cell in whole):.0f}"
        )
    _check_all_there(groups, cells)
    out_folder(args.out)
    by = [BY[name] for name in dict.fromkeys(args.by)]
    findings = _findings(cells, by, planned=args.groups is not None)
    findings["missing"] = returns_tables.missing(whole, envs, args.learner)
    _write(args, cells, left_out, findings)
    _print(args, findings, left_out)
    return 0


def _steps(words: Sequence[str], envs: Sequence[str]) -> dict[str, int]:
    """The step of each environment that has one, from `STEP` (of all) or `ENV=STEP`."""
    of_all: dict[str, int] = {}
    of_one: dict[str, int] = {}
    for word in words:
        env, named, digits = word.rpartition("=")
        step = whole_number(digits)
        if not step:
            raise UserError(f"--at must be at least 1, or ENV=STEP, not '{word[:DIGITS]}'")
        if not named and of_all:
            raise UserError("--at takes one step of all, and one ENV=STEP for each other")
        if named and task(env).name not in envs:
            raise UserError(f"--at {word}: --env does not name {env}")
        if named:
            of_one[task(env).name] = step
        else:
            of_all = dict.fromkeys(envs, step)
    return of_all | of_one


def _with_seeds(runs: Sequence[RunReader], seeds: Sequence[int] | None) -> Sequence[RunReader]:
    if seeds is None:
        return runs
    chosen = [run for run in runs if run.seed in seeds]
    if not chosen:
        have = " ".join(map(str, sorted({run.seed for run in runs})))
        raise UserError(f"--seeds: no such run has one of them, but {have}")
    return chosen


def _called(group: str, usual: str) -> str:
    """A group's name in the tables, which leave the first preset out; Compare names every one."""
    return ", ".join(word for word in group.split(", ") if word != usual)


def _check_groups(groups: Sequence[str] | None, have: Sequence[str]) -> None:
    for group in groups or ():
        if group not in have:
            raise UserError(f"--groups: no such run is of '{group}', but of: {'; '.join(have)}")
    if groups is not None and len({*groups}) < 2:
        raise UserError(
            f"--groups: one alone is compared with nobody; name two of: {'; '.join(have)}"
        )


def _check_all_there(groups: Sequence[str] | None, cells: Sequence[study.Cell]) -> None:
    """A planned comparison is made whole or not at all: p is corrected for what was planned."""
    for group in groups or ():
        if not any(cell.label == group for cell in cells):
            raise UserError(
                f"--groups: no run of '{group}' can be compared with the others at one step; "
                "choose another --at, or leave it out"
            )


def _findings(cells: list[study.Cell], by: Sequence[str], *, planned: bool) -> dict[str, Any]:
    return {
        "verdict": verdicts.returns(cells),
        "summary": returns_tables.summary(cells),
        "improvement": returns_tables.improvement(cells, by, planned=planned),
        "factors": returns_factors.factors(cells, by),
        "exams": returns_fits.exams(cells),
        "rollouts": returns_fits.rollouts(cells),
        "less": returns_fits.less(cells, planned=planned),
    }


def _write(
    args: argparse.Namespace, cells: list[study.Cell], left_out: list[str], findings: dict[str, Any]
) -> None:
    out: Path = args.out
    curves = (
        {"env": c.env, "learner": c.label, "seed": curve.seed, "run": curve.run_id,
         "step": int(step), "return": value, "best": best}
        for c in cells
        for curve in c.curves
        for step, value, best in zip(curve.step, curve.value, curve.best_so_far.value, strict=True)
    )  # fmt: skip
    write_csv(out / "returns.csv", curves)
    for name in ("summary", "improvement", "factors", "exams", "rollouts", "less", "missing"):
        write_csv(out / f"{name}.csv", findings[name])
    png, _ = save(return_figure(cells), out, "returns")
    runs = [run for cell in cells for run in cell.runs]
    aside = [
        "Left out, for other settings, a longer run of the seed, no evaluation, a first one "
        f"after the others' end, or an end before --at: {', '.join(left_out)}."
    ]
    tables = [
        (
            f"Returns up to {_step(args.at)}; mean, median and IQM are of the best",
            findings["summary"],
        ),
        (WINS, findings["improvement"]),
        *([(FACTORS, findings["factors"])] if findings["factors"] else []),
        (EXAMS, findings["exams"]),
        (ROLLOUTS, findings["rollouts"]),
        (LESS, findings["less"]),
        ("What is missing for the paper's figure", findings["missing"]),
    ]
    made = origin_of(runs) | {"seeds": seeds([run.seed for run in runs])}
    said = [*findings["verdict"], *(aside if left_out else [])]
    write_report(
        Report("Returns of every learner", CLAIM, said, [(CAPTION, png)], tables, made), out
    )


def _print(args: argparse.Namespace, findings: dict[str, Any], left_out: list[str]) -> None:
    if args.json:
        print_json({**findings, "left out": left_out, "out": str(args.out)})
        return
    names = ("env", "learner", "n", "at step", "best return", "IQM", "last", "area", "remark")
    rows = [
        [
            row["env"], row["learner"], str(row["n"]), str(row["at step"]),
            _interval(row["mean"], row["low"], row["high"]), _cell(row["IQM"]),
            _cell(row["final"]), _interval(row["area"], row["area low"], row["area high"]),
            row["remark"],
        ]
        for row in findings["summary"]
    ]  # fmt: skip
    show(f"Returns up to {_step(args.at)}", names, rows)
    if findings["improvement"]:
        names = ("learner", "against", "by", "wins", "low", "high", "p", "p of all", "tasks")
        rows = [[_cell(row[name], ".2g") for name in names] for row in findings["improvement"]]
        show(WINS, names, rows)
    if findings["factors"]:
        names = ("env", "learner", "effect of", "by", "effect", "wins", "p", "p of all", "remark")
        rows = [
            [
                row["env"], row["learner"], row["effect of"], row["by"],
                _interval(row["effect"], row["low"], row["high"]),
                *(_cell(row[name], ".2g") for name in names[5:8]), row["remark"],
            ]
            for row in findings["factors"]
        ]  # fmt: skip
        show(FACTORS, names, rows)
    for key, title, of_fits in (
        ("exams", EXAMS, returns_fits.EXAMS.values()),
        ("rollouts", ROLLOUTS, returns_fits.ROLLOUTS),
    ):
        if findings[key]:
            names = ("env", "learner", "n", *of_fits)
            rows = [
                [*(str(row[n]) for n in names[:3]), *(_range(row, n) for n in names[3:])]
                for row in findings[key]
            ]
            show(title, names, rows)
    _print_less(args, findings)
    for line in findings["verdict"]:
        print(line)
    if left_out:
        print(f"Left out: {', '.join(left_out)} (the report says for what).")
    print(f"{len(findings['missing'])} of the paper's curves are missing or short: {args.out}")


def _print_less(args: argparse.Namespace, findings: dict[str, Any]) -> None:
    """The comparisons of exams, of many groups by the file that has them."""
    many = len({row["learner"] for row in findings["summary"]}) > FEW
    if many and args.groups is None and findings["less"]:
        print(f"{LESS}: {args.out / 'less.csv'}, or here with --groups.")
    elif findings["less"]:
        names = ("learner", "against", "in", "less", "low", "high", "p", "p of all", "tasks")
        show(LESS, names, [[_cell(row[name], ".2g") for name in names] for row in findings["less"]])


def _step(at: Sequence[str]) -> str:
    """The step of the comparison in words."""
    words = sorted((word.rpartition("=") for word in at), key=lambda word: not word[1])
    steps = [f"step {step} of {env}" if env else f"step {step}" for env, _, step in words]
    if all(env for env, _, _ in words):
        steps.append("the step that all runs of an environment reach")
    return ", else ".join(steps)


def _cell(value: Any, form: str = ".1f") -> str:
    if value is None or value != value:
        return "-"
    return f"{value:{form}}" if isinstance(value, float) else str(value)


def _interval(value: float, low: float, high: float) -> str:
    return f"{value:.1f} [{low:.1f}, {high:.1f}]" if low == low else f"{value:.1f}"


def _range(row: dict[str, Any], name: str) -> str:
    value, low, high = row[name], row[f"{name} low"], row[f"{name} high"]
    return _cell(value, ".3g") if low != low else f"{value:.3g} [{low:.3g}, {high:.3g}]"
