"""Import the modules of tasks and termination rules that the command line names."""

import argparse

from tom.cli.parser import DEST

TERMINATION = "model.termination"


def add_termination(parser: argparse._ActionsContainer) -> None:
    """Add `--termination`, a short form of the setting `model.termination`."""
    parser.add_argument(
        "--termination",
        dest=DEST + TERMINATION,
        metavar="module:function",
        help="what ends an episode in the model: next observations (B, O) in the task's units -> "
        "bool (B,); or never; or learnt, by a head of the model (short for --model.termination)",
    )


def bring_named(args: argparse.Namespace) -> None:
    """Import the modules of the tasks and the rule that these arguments name. Raises UserError."""
    given, rule = getattr(args, "env", None), getattr(args, DEST + TERMINATION, None)
    if given is None and rule is None:
        return
    from tom.envs import bring  # a simulator takes a second to import
    from tom.envs.termination import bring_rule

    for name in given if isinstance(given, list) else [given]:
        bring(name)
    bring_rule(rule)
