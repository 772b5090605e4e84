"""What a model would have learnt if a region of the replay buffer had counted more or less.

The weights of the region are multiplied by a factor, and all are scaled back to mean 1. One model
is fitted with these weights and one with the original weights, on the same episodes, from the same
initial parameters and with the same random draws; every learner's are clipped for the fit, as TOM's
are in a training. Both are tested on held-out episodes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf, nan

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.analysis.weighing import fit_model
from tom.config import ModelConfig
from tom.data.sampling import held_out_rows, normalise
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import DynamicsModel
from tom.errors import UserError
from tom.exams.diagnostics import one_step_error, step_scale
from tom.learners.base import Weighting
from tom.rng import Streams

UNCHANGED = 1.0
FACTORS = (0.0, 0.25, 4.0)
HELD_OUT = 0.2
"""share of the buffer that is held out, in whole episodes"""
REGION, REST, POLICY = "region", "rest", "policy"
SMALL = ModelConfig(hidden=32, layers=2, components=1, rounds=8)
"""the default model: fitted in seconds, and small enough that weights matter"""


@dataclass(frozen=True)
class BrushedFit:
    """A model fitted with brushed weights (N,) under one seed.

    `errors` are one-step errors, in standard deviations of a step's change, on three sets: held-out
    rows inside the region, held-out rows outside it, and fresh transitions of the policy. NaN for
    an empty set.
    """

    factor: float
    seed: int
    weights: NDArray[np.float32]
    errors: dict[str, float]
    model: DynamicsModel = field(repr=False, compare=False)


def check_factor(factor: float) -> None:
    """Raises UserError for a factor that weights cannot be multiplied by."""
    if not 0 <= factor < inf:  # NaN is neither
        raise UserError(f"factor {factor:g}: must be a finite number, at least 0")


def brushed_weights(weights: Tensor, region: Tensor, factor: float) -> Tensor:
    """The weights (N,), multiplied by `factor` in the region (N,), then scaled to mean 1.

    Raises UserError if all weights would be zero.
    """
    normalised, degenerate = normalise(torch.where(region, factor * weights, weights))
    if degenerate:
        raise UserError("the region holds all of the weight: nothing is left without it")
    return normalised


def fit_brushed(
    rows: TensorTransitions,
    weights: Tensor,
    region: Tensor,
    fresh: TensorTransitions | None,
    config: ModelConfig,
    factors: Sequence[float],
    seeds: Sequence[int],
) -> Iterator[BrushedFit]:
    """Fit a model for every seed and factor and yield each when it is ready; factor 1 comes first.

    `rows` are oldest first, with their weights (N,) of mean 1, and the region a mask (N,); `fresh`
    are new transitions of the policy of interest. A seed fixes the held-out episodes and all random
    draws of a fit, so that factors compare. Raises UserError if nothing or all is in the region, or
    nothing with a weight is left to fit to.
    """
    if not bool(region.any()) or bool(region.all()):
        raise UserError("the region must hold some of the buffer's transitions, not all")
    every = {factor: brushed_weights(weights, region, factor) for factor in (UNCHANGED, *factors)}
    scale = step_scale(rows)
    for seed in seeds:
        held_out = held_out_rows(rows, HELD_OUT, Streams(seed).torch("held out"))
        kept = (~held_out).nonzero().squeeze(1)
        judged = {
            REGION: rows[(held_out & region).nonzero().squeeze(1)],
            REST: rows[(held_out & ~region).nonzero().squeeze(1)],
        }
        if fresh is not None:
            judged[POLICY] = fresh
        for factor, of_all in every.items():
            own, degenerate = normalise(of_all[kept])
            if degenerate:
                raise UserError("the episodes left for the fit have no weight: draw another region")
            model = fit_model(rows[kept], Weighting(own, clipped=True), config, seed)
            errors = {
                name: one_step_error(model, some, scale) if len(some) else nan
                for name, some in judged.items()
            }
            yield BrushedFit(factor, seed, of_all.numpy(), errors, model)
