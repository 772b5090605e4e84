"""What a model fit is judged by: the weights' shape and where the model errs.

`model/error_policy` against `model/error_other` is the evidence whether a learner focuses the
model on the data that the current policy meets.
"""

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor

from tom.data.sampling import ess, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import DynamicsModel
from tom.learners.base import FitContext, Weighting

ROWS = 2000  # transitions a one-step error is measured on
RANKED = 20_000  # transitions a rank correlation is measured on


def weight_metrics(weights: Tensor) -> dict[str, float]:
    """Shape of weights (N,), oldest first: ess, share of zeros, largest, rank against position."""
    w = weights.to(torch.float64).numpy()
    step = max(len(w) // RANKED, 1)
    thinned = w[::step]
    varied = len(thinned) > 1 and bool(np.ptp(thinned) > 0)
    rank = np.corrcoef(rankdata(thinned), np.arange(len(thinned)))[0, 1] if varied else 0.0
    return {
        "weights/ess": ess(weights),
        "weights/zeros": float((w == 0).mean()),
        "weights/max": float(w.max()),
        "weights/age_correlation": float(rank),
    }


@torch.no_grad()
def one_step_error(model: DynamicsModel, rows: TensorTransitions, scale: Tensor) -> float:
    """Root mean square error of the predicted next_obs, each dimension in units of `scale` (O,)."""
    _, predicted = model.predict(rows.obs, rows.action)
    return float(((predicted - rows.next_obs) / scale).square().mean().sqrt())


def fit_metrics(
    model: DynamicsModel, context: FitContext, weighting: Weighting, generator: torch.Generator
) -> dict[str, float]:
    """Metrics of one model fit: the weights' shape and the errors on and off policy."""
    replay = context.replay
    metrics = {**weight_metrics(weighting.weights), "buffer/size": float(len(replay))}
    others = len(replay) - len(context.policy_buffer)  # the policy buffer is the newest rows
    if others < 1 or not len(context.policy_buffer):
        return metrics
    rows = replay[uniform_indices(others, ROWS, generator)]
    change = rows.next_obs - rows.obs
    scale = change.std(0, correction=0).clamp(min=1e-6)
    return {
        **metrics,
        "model/error_policy": one_step_error(model, context.policy_buffer, scale),
        "model/error_other": one_step_error(model, rows, scale),
    }
