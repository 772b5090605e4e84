"""Which next observations end an episode, for rollouts in a learnt model.

The functions of our tasks map next_obs (B, O) to a bool tensor (B,), with the bounds of Gymnasium's
v5 task of that name only. If the task tests a bound, a NaN ends the episode. `rule` is the rule of
a training: the task's own, or the user's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from tom.envs.task import Task, Termination
from tom.envs.user_code import import_function, running_user_code
from tom.errors import OwnCodeError, UserError, unknown

if TYPE_CHECKING:
    from torch import Tensor


def never(next_obs: Tensor) -> Tensor:
    return next_obs.new_zeros(len(next_obs)).bool()


def inverted_pendulum(next_obs: Tensor) -> Tensor:
    """Ends unless finite and |pole angle| <= 0.2 rad. obs = (cart x, pole angle, ...)."""
    return ~(next_obs.isfinite().all(dim=1) & (next_obs[:, 1].abs() <= 0.2))


def hopper(next_obs: Tensor) -> Tensor:
    """Ends unless finite, |obs[1:]| < 100, z > 0.7 and |angle| < 0.2. obs = (z, angle, ...).

    The bound on the state is two-sided; the released code has only the upper one.
    """
    z, angle = next_obs[:, 0], next_obs[:, 1]
    bounded = z.isfinite() & (next_obs[:, 1:].abs().amax(1) < 100)  # false for NaN
    return ~(bounded & (z > 0.7) & (angle.abs() < 0.2))


def walker2d(next_obs: Tensor) -> Tensor:
    """Ends unless 0.8 < z < 2.0 and |angle| < 1. obs = (z, angle, ...)."""
    z, angle = next_obs[:, 0], next_obs[:, 1]
    return ~((z > 0.8) & (z < 2.0) & (angle.abs() < 1.0))


def ant(next_obs: Tensor) -> Tensor:
    """Ends unless finite and 0.2 <= z <= 1.0. obs = (z, ...)."""
    z = next_obs[:, 0]
    return ~(next_obs.isfinite().all(dim=1) & (z >= 0.2) & (z <= 1.0))


def humanoid(next_obs: Tensor) -> Tensor:
    """Ends unless 1.0 <= z <= 2.0 (Gymnasium leaves the two bounds out). obs = (z, ...)."""
    z = next_obs[:, 0]
    return ~((z >= 1.0) & (z <= 2.0))


NEVER = "never"
LEARNT = "learnt"
"""learnt by a head of the dynamics model: `tom.dynamics.ending`"""
RULES: dict[str, Termination] = {NEVER: never}
"""rules by name: of plug-ins, and of modules that the user named"""


def import_rule(name: str | None) -> None:
    """Import and register the rule `module:function`: code that the user chose to run.

    Raises UserError if there is no such function.
    """
    if name is not None and ":" in name and name not in RULES:
        # Its answers are checked in `rule`.
        RULES[name] = cast(Termination, import_function(name, "--termination"))


def imported_rules() -> list[str]:
    """The rules whose modules the user named to this process."""
    return [name for name in RULES if ":" in name]


def learns_ends(task: Task, name: str | None) -> bool:
    """Whether a head of the model learns the ends: on request, or if there is no rule."""
    return name == LEARNT or (name is None and not task.knows_ends)


def rule(task: Task, name: str | None) -> Termination:
    """The termination rule for modelled episodes; without a name the task's own rule.

    If a head of the model `learns_ends`, it replaces this rule, which then never ends an episode.
    Raises UserError for an unknown name: nothing is imported here (see `import_rule`).
    """
    if name is None:
        return task.terminated
    if name in (LEARNT, NEVER):
        return never
    if name in RULES:
        return checked_rule(RULES[name], task, name)
    if ":" in name:
        raise UserError(
            f"termination {name} is code, which is imported only where you name it: add "
            f"--termination {name}"
        )
    raise unknown("termination", name, (*RULES, LEARNT))


def checked_rule(rule_of_user: Termination, task: Task, name: str) -> Termination:
    """The user's rule `given` for observations as agents see them, after a test call.

    It raises OwnCodeError where it fails or its answer is not a valid one.
    """
    import torch

    offset, scale = (torch.tensor(x, dtype=torch.float32) for x in task.obs_units)

    def terminated(next_obs: Tensor) -> Tensor:
        with running_user_code(f"termination {name} for next observations {tuple(next_obs.shape)}"):
            answer = rule_of_user(next_obs * scale.to(next_obs) + offset.to(next_obs))
        if (
            not isinstance(answer, torch.Tensor)
            or answer.shape != next_obs.shape[:-1]
            or answer.dtype != torch.bool
        ):
            raise OwnCodeError(
                f"termination {name} must map next observations (B, {task.obs_dim}), a tensor, to "
                "a bool tensor (B,)"
            )
        return answer

    terminated(torch.zeros(3, task.obs_dim))
    return terminated
