"""`tom reproduce focus`: does weighting make the model better where the policy goes?"""

import argparse
from dataclasses import asdict

from tom.cli.reproduce.study import (
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
from tom.record import Store
from tom.reports.files import write_csv
from tom.reports.html import Report, write_report
from tom.reports.origin import seeds as in_short
from tom.reports.style import save
from tom.studies.each import each
from tom.studies.focus import QUANTITIES, Focus, cases, focus, summary, verdict
from tom.studies.focus_figure import error_figure
from tom.studies.report import study_origin

CLAIM = (
    "Fitting the model to what the current policy meets makes it accurate there, where policy "
    "learning needs it, rather than over all of the replay buffer (figure 1). The paper measures "
    "no model error on MuJoCo tasks."
)
CAPTION = (
    "Error of each learner's model as a share of MLE's, a point a seed (1: no difference). The "
    "buffer's two halves are in-sample, the policy's own transitions are new to every learner."
)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "focus",
        help="model error where the policy goes, for every learner on the same buffer",
        description="Weigh the replay buffer of SAC recordings (made where the store has none) for "
        "the policy that SAC ended with, fit the paper's model afresh with each learner's weights, "
        "and measure its error on transitions that the policy makes anew and on the buffer's two "
        "halves. Nothing is accepted or refused: it says for whom weighting helped, and where.",
    )
    add_recordings(parser)
    add_output(parser, "focus")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    check_recordings(args)
    envs = tasks(args.env)
    out_folder(args.out)
    runs = sac_recordings(Store(args.store), envs, None, args.steps)
    results: list[Focus] = []
    for one in each(focus, cases(runs, args.seeds), args.jobs, args.out):
        results.append(one)
        say(f"{one.recording}: {one.rival} seed {one.seed}")
    _write_and_print(results, args)
    return 0


def _write_and_print(results: list[Focus], args: argparse.Namespace) -> None:
    rows = summary(results)
    write_csv(args.out / "errors.csv", [asdict(one) for one in results])
    write_csv(args.out / "summary.csv", rows)
    png, _ = save(error_figure(results), args.out, "errors")
    said = verdict(results)
    n = f"{len({f.recording for f in results})} recordings, {len(args.seeds)} seeds on each"
    made = study_origin(n=n, seeds=in_short(args.seeds))
    tables = [("Medians over seeds", rows)]
    write_report(Report("Model error", CLAIM, said, [(CAPTION, png)], tables, made), args.out)
    if args.json:
        print_json({"summary": rows, "verdict": said, "out": str(args.out)})
        return
    show(
        f"Model error, median over seeds {' '.join(map(str, args.seeds))} (over MLE's)",
        ("recording", "learner", "ESS", *QUANTITIES.values()),
        [
            (
                str(row["recording"]),
                str(row["rival"]),
                f"{row['ess']:.3f}",
                *(f"{row[q]:.3f} ({row[f'{q} / mle']:.2f})" for q in QUANTITIES),
            )
            for row in rows
        ],
    )
    print("\n".join([*said, str(args.out)]))
