"""`tom answer`: the three cards of the studio's page Answer, in the terminal."""

import argparse
from dataclasses import asdict, replace

from tom.analysis.answer import QUESTIONS, answers, side_of
from tom.analysis.grouping import grouped, usual_other, usual_task
from tom.cli.output import print_problems, print_result
from tom.cli.parser import add_json, add_store
from tom.errors import UserError, check_known
from tom.record.store import Store


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "answer",
        description="Where does a learner look, is that where its policy goes, and does it help? "
        "One group of runs against another, as the studio's page Answer compares them.",
    )
    add_store(parser)
    # Named like that, it is not imported: a recorded task can be read without its code.
    parser.add_argument("--env", dest="task", help="the task [the newest training's]")
    parser.add_argument("--one", metavar="GROUP", help='the group, such as "TOM" or "TOM paper"')
    parser.add_argument("--other", metavar="GROUP", help="the group that it is compared with")
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the three answers. Raises UserError if there is no such task or group."""
    store = Store(args.store)
    store.ensure_there()
    runs = store.runs()
    print_problems(store)
    if not runs:
        raise UserError(f"{args.store}/ has no runs")
    env = args.task or usual_task(runs)
    check_known("task", [env], sorted({run.env for run in runs}))
    found = grouped([run for run in runs if run.env == env])
    shown, groups = found.comparable(), replace(found, hidden=frozenset()).comparable()
    if not groups:
        raise UserError(f"no run of {env} learns a model yet: name another --env")
    one = args.one or next(iter(shown))
    other = args.other or usual_other(shown, one)
    check_known("group", [title for title in (one, other) if title], groups)
    sides = {title: side_of(title, groups[title]) for title in (one, other) if title}
    by_question = zip(QUESTIONS, answers(sides[one], sides.get(other or "")), strict=True)
    chosen = {title: [run.run_id for run in groups[title]] for title in sides}
    lines = [f"{env}: {', '.join(f'{title} (n = {len(ids)})' for title, ids in chosen.items())}"]
    told = {}
    for question, answer in by_question:
        told[question] = asdict(answer)
        lines += ["", f"{question} {answer.verdict}."]
        lines += [text.replace("**", "") for text in (answer.sentence, answer.more) if text]
    return print_result(args, {"env": env, "groups": chosen, "answers": told}, lines)
