"""Which modelled observations end an episode: the task's own rule, or the user's."""

from typing import cast

from tom.envs.gymnasium_task import GymnasiumTask, in_own_units
from tom.envs.task import Task, Termination
from tom.envs.termination import never
from tom.envs.user_code import import_named, tried
from tom.errors import UserError, unknown

NEVER = "never"
LEARNT = "learnt"
"""learnt by a head of the dynamics model: `tom.dynamics.ending`"""
RULES: dict[str, Termination] = {NEVER: never}
"""rules by name: of plug-ins, and of modules that the user named"""


def bring_rule(name: str | None) -> None:
    """Import and register the rule `module:function`: code that the user chose to run.

    Raises UserError if there is no such function.
    """
    if name is None or ":" not in name or name in RULES:
        return
    module, _, function = name.partition(":")
    given = getattr(import_named(module, f"--termination {name}"), function, None)
    if not callable(given):
        raise UserError(f"--termination {name}: module '{module}' has no function '{function}'")
    RULES[name] = cast(Termination, given)  # what it answers is tried in `rule`


def brought_rules() -> list[str]:
    """The rules whose modules the user named to this process."""
    return [name for name in RULES if ":" in name]


def learns_ends(known: Task, name: str | None) -> bool:
    """Whether a head of the model learns the ends: on request, or if there is no rule."""
    return name == LEARNT or (name is None and not known.knows_ends)


def rule(known: Task, name: str | None) -> Termination:
    """The termination rule for modelled episodes; without a name the task's own rule.

    If a head of the model `learns_ends`, it replaces this rule, which then never ends an episode.
    Raises UserError for an unknown name: nothing is imported here (see `bring_rule`).
    """
    if name is None:
        return known.terminated
    if name == LEARNT:
        return never
    if name not in RULES:
        if ":" in name:
            raise UserError(
                f"termination {name} is code, which is imported where you name it alone: add "
                f"--termination {name}"
            )
        raise unknown("termination", name, (*RULES, LEARNT))
    given = RULES[name]
    wrapped = in_own_units(given, known) if isinstance(known, GymnasiumTask) else given
    return wrapped if name == NEVER else tried(wrapped, known, name)
