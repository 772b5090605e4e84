"""`tom record-sac`: equally many random and SAC steps, with the replay buffer kept in order."""

import argparse

from tom.cli.parser import add_config_options, add_run_options, leaf_fields, overrides
from tom.cli.train import OWN_OPTIONS, start_training
from tom.config import SacRecordingConfig
from tom.envs import ANY, ENVS, task

WITHOUT_MEANING = ("tom.", "pmac.", "vagram.", "bins", "device")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "record-sac",
        description="Record N random steps, then N steps of soft actor-critic in order, with the "
        "MuJoCo states and the final policy. `tom weigh RUN --policy RUN` shows how the learners "
        "weigh it.",
    )
    parser.add_argument("--env", required=True, metavar="ENV", help=f"{', '.join(ENVS)}, {ANY}")
    parser.add_argument(
        "--resume",
        choices=("auto",),
        help="auto: continue the newest incomplete recording of this same command, or begin a new "
        "one (to continue a recording by name: tom train --resume RUN)",
    )
    parser.add_argument("--run-id", help="name of the run folder [env-sac-seed-time]")
    add_run_options(parser)
    left_out = (*OWN_OPTIONS, *WITHOUT_MEANING)
    paths = {path for path, _ in leaf_fields(SacRecordingConfig) if path.startswith(left_out)}
    add_config_options(parser, SacRecordingConfig, leave_out=paths)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    env = task(args.env).name
    return start_training(SacRecordingConfig(env=env).but(**overrides(args)), args)
