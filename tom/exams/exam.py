"""A fit's exam: its quality on the steps that it served (prequential evaluation, Dawid 1984).

The model fitted at step t is used until the next fit. The transitions collected meanwhile are not
in its buffer; they are its exam: out of sample, and from the policy that the weights were computed
for. docs/exams.md has the idea, every number and its limits.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import torch
from torch import Tensor

from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import DynamicsModel
from tom.exams.diagnostics import HORIZON, predict_steps_ahead, rms, rollout_starts
from tom.exams.energy import footprint_match, step_scaling

CAUGHT_DRAWS, FALSE_DRAWS = 32, 4
"""predictions for each terminated row (there are few), and for each other row"""


@dataclass(frozen=True)
class Fitted:
    """A fit before its exam: its step, and the weight of each row in it, (N,)."""

    env_step: int
    weights: Tensor


@dataclass(frozen=True)
class Exam:
    """The buffer of a fit with its weights (N,), and the rows collected since then, in order."""

    buffer: TensorTransitions
    weights: Tensor
    rows: TensorTransitions

    @classmethod
    def of(cls, fitted: Fitted, replay: TensorTransitions, new: int) -> Self:
        """The exam whose rows are the newest `new` of the replay buffer.

        Rows that the replay buffer has dropped since the fit are missing.
        """
        held = max(len(replay) - new, 0)
        weights = fitted.weights[len(fitted.weights) - held :]
        return cls(replay[:held], weights, replay[held:])

    @cached_property
    def scaling(self) -> Scaling:
        """The scaling of (s, a, s' - s) by the buffer's moments."""
        return step_scaling(self.buffer)


class Critic(Protocol):
    """A policy and its soft Q, as SAC has them."""

    def draw(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A sampled action (B, A) for each of obs (B, O), and its log_prob (B,)."""
        ...

    def value(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q(s, a), (B,)."""
        ...


def footprint_metrics(exam: Exam, generator: torch.Generator) -> dict[str, float]:
    """How near the weighted buffer is to the policy's transitions since (`footprint_match`)."""
    if not bool(exam.weights.any()):  # all rows with weight have been dropped
        return {}
    metrics = footprint_match(exam.buffer, exam.weights, exam.rows, exam.scaling, generator)
    return {f"exam/{name}": value for name, value in metrics.items()}


def model_metrics(
    model: DynamicsModel,
    exam: Exam,
    terminated: Callable[[Tensor], Tensor],
    generator: torch.Generator,
) -> dict[str, float]:
    """Errors of the model on the exam, one step and `HORIZON` steps ahead, and of its terminations.

    In units of the standard deviation of a step's change, and of the reward, in the buffer.
    `terminated` maps next_obs (B, O) to the mask (B,) of those that end an episode.
    """
    rows, buffer = exam.rows, exam.buffer
    if not len(buffer):
        return {}
    change = exam.scaling.std[-rows.obs.shape[1] :]
    spread = Scaling.of((buffer.reward[:, None],)).std
    metrics = {}
    every = torch.arange(len(rows), device=rows.obs.device)
    for ahead, starts, steps in (("", every, 1), ("rollout_", rollout_starts(rows), HORIZON)):
        if len(starts):
            last = starts + steps - 1
            reward, next_obs = predict_steps_ahead(model, rows, starts, steps)
            metrics[f"exam/{ahead}error"] = rms(next_obs - rows.next_obs[last], change)
            metrics[f"exam/{ahead}reward_error"] = rms(reward - rows.reward[last], spread)
    nll = model.nll(rows)
    if nll is not None:
        metrics["exam/nll"] = float(nll.mean())
    fell = rows.terminated > 0
    for name, some, draws in (
        ("falls_caught", rows[fell], CAUGHT_DRAWS),
        ("false_falls", rows[~fell], FALSE_DRAWS),
    ):
        if len(some):
            obs, action = (x.repeat(draws, 1) for x in (some.obs, some.action))
            _, next_obs = model.sample(obs, action, generator)
            metrics[f"exam/{name}"] = float(terminated(next_obs).float().mean())
    return metrics


def critic_metrics(
    critic: Critic,
    rows: TensorTransitions,
    temperature: Tensor | float,
    discount: float,
    generator: torch.Generator,
) -> dict[str, float]:
    """`exam/critic_bias`: mean return to go of the episodes that finished, minus Q(s, a).

    SAC's Q contains the entropy from the next step on, so the return must as well: every later
    state adds -temperature log pi(a'|s') of an action drawn there. (Drawn, not recorded: Q is that
    of the current policy, and log pi of a recorded action that tanh saturated to +-1 is lost.)
    """
    action, log_prob = critic.draw(rows.next_obs, generator)
    entropy = -temperature * log_prob
    returns = returns_to_go(rows, entropy, critic.value(rows.next_obs, action), discount)
    done = rows[: len(returns)]
    if not len(done):
        return {}
    return {"exam/critic_bias": float((returns - critic.value(done.obs, done.action)).mean())}


def returns_to_go(
    rows: TensorTransitions, entropy: Tensor, next_value: Tensor, discount: float
) -> Tensor:
    """G (K,) of the first K of N rows in order, up to the last row that ends an episode.

    G_t = r_t + g (entropy_t + G_{t+1}), where `entropy` (N,) is that of the policy at next_obs. A
    terminated episode ends with its reward; a truncated one is continued with `next_value` (N,),
    which is Q there.
    """
    ended = torch.nonzero((rows.terminated + rows.truncated) > 0).flatten().tolist()
    count = ended[-1] + 1 if ended else 0
    columns = rows.reward, rows.terminated, rows.truncated, entropy, next_value
    steps = torch.stack(columns, 1)[:count].tolist()
    returns, ahead = [0.0] * count, 0.0
    for t in reversed(range(count)):
        reward, terminated, truncated, bonus, value = steps[t]
        following = value if truncated else ahead
        ahead = reward if terminated else reward + discount * (bonus + following)
        returns[t] = ahead
    return torch.tensor(returns, device=rows.obs.device)
