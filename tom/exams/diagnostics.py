"""Metrics of a model fit: the shape of the weights and the errors of the model.

`model/error_policy` against `model/error_other` says whether a learner focuses the model on the
data that the current policy meets. Both are in-sample: the model was just fitted to these rows.
`tom reproduce capacity` measures errors on transitions that the model was not fitted to.
"""

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tom.data.sampling import ess, uniform_indices, zero_share
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import DynamicsModel, Predictor
from tom.learners.base import FitContext, Weighting

ROWS = 2000  # transitions for a one-step error
HORIZON = 5  # steps of a rollout error
ROWS_AT_ONCE = 4096  # predicted; more do not fit the processor's cache
RANKED = 20_000  # transitions for a rank correlation


def weight_metrics(weights: Tensor) -> dict[str, float]:
    """Shape of weights (N,), oldest first: ESS, zeros, maximum, rank correlation with position."""
    w = weights.to("cpu", torch.float64).numpy()
    step = max(len(w) // RANKED, 1)
    thinned = w[::step]
    varied = len(thinned) > 1 and bool(np.ptp(thinned) > 0)
    ranks = pd.Series(thinned).rank()
    rank = np.corrcoef(ranks, np.arange(len(thinned)))[0, 1] if varied else 0.0
    return {
        "weights/ess": ess(weights),
        "weights/zeros": zero_share(weights),
        "weights/max": float(w.max()),
        "weights/age_correlation": float(rank),
    }


@torch.no_grad()
def one_step_error(model: DynamicsModel, rows: TensorTransitions, scale: Tensor) -> float:
    """Root mean square error of the predicted next_obs, each dimension in units of `scale` (O,)."""
    _, predicted = model.predict(rows.obs, rows.action)
    return rms(predicted - rows.next_obs, scale)


def step_scale(rows: TensorTransitions) -> Tensor:
    """Standard deviation of a step's change in each dimension of the state, (O,).

    One where the change is constant, as in the model's targets and in exams.
    """
    return Scaling.of((), (rows.next_obs, rows.obs)).std


@torch.no_grad()
def errors_of_rows(model: Predictor, rows: TensorTransitions) -> Tensor:
    """One-step error (N,) of the predicted next_obs, root mean square over dimensions.

    Each dimension is divided by the standard deviation of its change over these rows, as in
    `model/error_policy`.
    """
    scale, parts = step_scale(rows), []
    for first in range(0, len(rows), ROWS_AT_ONCE):
        part = rows[first : first + ROWS_AT_ONCE]
        _, predicted = model.predict(part.obs, part.action)
        error = (predicted - part.next_obs) / scale
        parts.append(error.square().mean(1).sqrt())
    return torch.cat(parts) if parts else rows.reward.new_zeros(0)


def rms(error: Tensor, scale: Tensor) -> float:
    """Root mean square of errors (N, O) or (N,), each dimension in units of `scale`."""
    return float((error / scale).square().mean().sqrt())


def rollout_error(
    model: DynamicsModel, rows: TensorTransitions, starts: Tensor, scale: Tensor
) -> float:
    """Error of next_obs after `HORIZON` steps of the model (`predict_steps_ahead`)."""
    _, obs = predict_steps_ahead(model, rows, starts, HORIZON)
    return rms(obs - rows.next_obs[starts + HORIZON - 1], scale)


@torch.no_grad()
def predict_steps_ahead(
    model: DynamicsModel, rows: TensorTransitions, starts: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """The last (reward (K,), next_obs (K, O)) of `steps` (1 or more) of the model's mean.

    Under the recorded actions: `rows` are in order of collection, and `steps` rows of one episode
    begin at each of `starts` (K,). So the recording shows what the real environment did from the
    same state.
    """
    obs, reward = rows.obs[starts], rows.reward[starts]
    for step in range(steps):
        reward, obs = model.predict(obs, rows.action[starts + step])
    return reward, obs


def ending_metrics(
    replay: TensorTransitions, policy_buffer: TensorTransitions, weights: Tensor
) -> dict[str, float]:
    """The weight of transitions that end in a terminal state, if there are any.

    Their share of the weights (N,), and their share of the policy's last transitions.
    """
    ends = replay.terminated
    if not len(policy_buffer) or not bool(ends.any()) or not bool(weights.any()):
        return {}
    return {
        "weights/ends": float((weights * ends).sum() / weights.sum()),
        "weights/ends_policy": float(policy_buffer.terminated.mean()),
    }


def rollout_starts(rows: TensorTransitions) -> Tensor:
    """The rows (K,) at which `HORIZON` rows of one episode begin."""
    ended = ((rows.terminated + rows.truncated) > 0).to(torch.float32)
    if len(rows) < HORIZON:
        return torch.empty(0, dtype=torch.int64)
    # An end at the last step is allowed: nothing is predicted beyond it.
    inner = ended.unfold(0, HORIZON, 1)[:, :-1].sum(1)
    return torch.nonzero(inner == 0).squeeze(1)


def fit_metrics(
    model: DynamicsModel, context: FitContext, weighting: Weighting, generator: torch.Generator
) -> dict[str, float]:
    """Metrics of one model fit: the weights' shape and the errors on and off policy.

    Errors are in standard deviations of a step's change, so that dimensions and tasks can be
    compared. They are in-sample; the rollout error off policy uses the newest 10 `ROWS` of the
    other rows.
    """
    replay = context.replay
    metrics = {**weight_metrics(weighting.weights), "buffer/size": float(len(replay))}
    metrics |= ending_metrics(replay, context.policy_buffer, weighting.weights)
    others = len(replay) - len(context.policy_buffer)  # the policy buffer is the newest rows
    if others < 1 or not len(context.policy_buffer):
        return metrics
    sample = replay[uniform_indices(others, ROWS, generator)]
    scale = step_scale(sample)
    metrics["model/error_policy"] = one_step_error(model, context.policy_buffer, scale)
    metrics["model/error_other"] = one_step_error(model, sample, scale)
    older = replay[max(others - 10 * ROWS, 0) : others]  # enough rows, as a view
    for name, rows in (("policy", context.policy_buffer), ("other", older)):
        starts = rollout_starts(rows)
        if len(starts):
            picked = starts[uniform_indices(len(starts), min(ROWS, len(starts)), generator)]
            metrics[f"model/rollout_error_{name}"] = rollout_error(model, rows, picked, scale)
    return metrics
