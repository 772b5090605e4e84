"""`tom reproduce`: compute a claim of the paper again and test it against its acceptance."""

from tom.cli.reproduce import (
    focus,
    progression,
    road,
    runner,
    tabular,
)
from tom.studies import capacity, footprint, improvement, online, returns

STUDIES = (
    road,
    progression,
    focus,
    tabular,
)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "reproduce",
        description="Reproduce a claim of the paper: compute it, print its acceptance figures and "
        "write its figure and table. Exit code 0 where all figures are met, 1 otherwise.",
    )
    studies = parser.add_subparsers(title="studies", metavar="STUDY", required=True)
    for study in STUDIES:
        study.add_parser(studies, arguments)
    for module in (footprint, capacity, improvement, online, returns):
        runner.add_parser(studies, module.STUDY)
