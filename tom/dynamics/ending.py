"""A head of the dynamics model that learns which next observations end an episode.

p(end | s') is a Bernoulli distribution whose logit is a network of s' (the task only tells that an
episode ended there). It is fitted by the same weighted maximum likelihood as the model, on the same
rows. The network goes on from fit to fit, so a row that one fit holds out is held out for good. A
modelled episode ends where p reaches the threshold that was best on held-out rows, of those that
could be best for a calibrated p.
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, relu

from tom.config import ModelConfig
from tom.data.sampling import WeightedSampler, uniform_indices
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import FitReport
from tom.nn.mlp import StackedMLP
from tom.nn.trained import Trained

HIDDEN = 64
ROUNDS = 5
"""rounds of `batches_per_round` minibatches in a fit; few, because only one number is learnt"""
BINS = 10
GOLDEN = 0.6180339887498949
"""the fractional part of the golden ratio"""
NEVER = 2.0
"""a threshold that no probability reaches"""
UNWEIGHTED = (
    "ends-unweighted",
    "no end of an episode among the training rows has any weight: the head that learns ends is "
    "fitted without weights",
)


class EndingHead:
    """The head of one member, with its threshold; before the first fit it never ends an episode."""

    def __init__(self, obs_dim: int, config: ModelConfig, generator: torch.Generator) -> None:
        net = StackedMLP(1, [obs_dim, HIDDEN, HIDDEN, 1], relu, generator)
        self.config = config
        self.network = Trained(net, config.lr)
        device = self.network.device
        self.mean, self.std = torch.zeros(obs_dim).to(device), torch.ones(obs_dim).to(device)
        self.threshold = NEVER

    def __call__(self, next_obs: Tensor) -> Tensor:
        """Which next_obs (B, O) end an episode, (B,)."""
        if self.threshold >= NEVER:
            return next_obs.new_zeros(len(next_obs)).bool()
        with torch.no_grad():
            return self.probability(next_obs) >= self.threshold

    def probability(self, next_obs: Tensor) -> Tensor:
        """p(end | s'), (B,), for next_obs (B, O)."""
        return torch.sigmoid(self._logit(next_obs))

    def fit(
        self,
        rows: TensorTransitions,
        weights: Tensor,
        collected: int,
        generator: torch.Generator,
    ) -> FitReport:
        """Fit to transitions with weights (N,), as the model's.

        The transitions are the last of all those that were ever `collected`. While those that are
        not held out contain no end of an episode, nothing is learnt and no episode ends. If none of
        their ends has any weight, all rows have the same, and a notice says so.
        """
        label = (rows.terminated > 0).to(rows.obs)
        held, kept = self._split(rows, collected)
        if not bool(label[kept].any()):
            self.threshold = NEVER
            return FitReport({"model/ends_threshold": NEVER})
        notices: tuple[tuple[str, str], ...] = ()
        if not bool((weights * label)[kept].any()):
            weights, notices = torch.ones_like(weights), (UNWEIGHTED,)
        scaling = Scaling.of((rows.next_obs,))
        self.mean, self.std = scaling.mean, scaling.std
        self._train(rows.next_obs[kept], label[kept], weights[kept], generator)
        # Ends are rare: if none is held out, all rows choose the threshold, and none can judge it.
        judged = bool((label * weights)[held].any())
        judges = held if judged else torch.cat((held, kept))
        with torch.no_grad():
            p = self.probability(rows.next_obs[judges])
        label, weights = label[judges], weights[judges]
        self.threshold = best_threshold(p, label, weights)
        metrics = measured(p, label, weights, self.threshold) if judged else {}
        return FitReport({"model/ends_threshold": self.threshold, **metrics}, notices)

    def state_dict(self) -> dict[str, Any]:
        return {
            "network": self.network.state_dict(),
            "mean": self.mean,
            "std": self.std,
            "threshold": self.threshold,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.network.load_state_dict(state["network"])
        self.mean = state["mean"].to(self.network.device)
        self.std = state["std"].to(self.network.device)
        self.threshold = state["threshold"]

    def _logit(self, next_obs: Tensor) -> Tensor:
        return self.network.net(((next_obs - self.mean) / self.std)[None])[0, :, 0]

    def _split(self, rows: TensorTransitions, collected: int) -> tuple[Tensor, Tensor]:
        """The positions of the rows that every fit holds out, and of the others.

        The k-th row ever collected is held out if the fractional part of k times the golden ratio
        is less than `holdout`: such rows are spread evenly, and without a period.
        """
        first, device = collected - len(rows), rows.obs.device
        k = 1 + torch.arange(first, collected, dtype=torch.float64, device=device)
        held = (k * GOLDEN) % 1 < self.config.holdout
        return held.nonzero()[:, 0], (~held).nonzero()[:, 0]

    def _train(
        self, next_obs: Tensor, label: Tensor, weights: Tensor, generator: torch.Generator
    ) -> None:
        drawn = self.config.weights == "sample"
        sampler = WeightedSampler(weights, generator) if drawn else None
        size = self.config.batch_size
        for _ in range(ROUNDS * self.config.batches_per_round):
            if sampler is not None:
                index, scale = sampler.draw(size), None
            else:
                index = uniform_indices(len(label), size, generator)
                scale = weights[index]
            logit = self._logit(next_obs[index])
            loss = binary_cross_entropy_with_logits(logit, label[index], scale)
            tensors = self.network.net.tensors()
            self.network.optimiser.step(torch.autograd.grad(loss, tensors))


def best_threshold(p: Tensor, label: Tensor, weights: Tensor) -> float:
    """The threshold on p (N,) with the largest weighted F1; .5 if there are no ends.

    F1 = 2 caught / (called + ends), where each term is the weight of these rows. Under a calibrated
    p the best threshold is half of the best F1 (Lipton, Elkan and Naryanaswamy 2014, "Optimal
    thresholding of classifiers to maximize F1 measure"), which is at least that of calling all
    rows, 2 s / (1 + s) at the ends' share s of the weight. So no threshold is below s / (1 + s):
    else the p of an end that looks like any other row would call most of them.
    """
    order = torch.argsort(p, descending=True)
    caught = (weights * label)[order].cumsum(0)
    called = weights[order].cumsum(0)
    ends = (weights * label).sum()
    if not bool(ends > 0):
        return 0.5
    lowest = float(ends / (weights.sum() + ends))
    score = 2 * caught / (called + ends)
    ranked = p[order]
    choice = ranked >= lowest
    choice[:-1] &= ranked[:-1] > ranked[1:]  # equal probabilities are on the same side
    at = int(torch.where(choice, score, -1.0).argmax())
    following = float(ranked[at + 1]) if at + 1 < len(ranked) else 0.0
    halfway = 0.5 * (float(ranked[at]) + following)  # to the next lower probability
    return max(halfway, lowest)


def measured(p: Tensor, label: Tensor, weights: Tensor, threshold: float) -> dict[str, float]:
    """Metrics of the head on rows (N,) that it was never fitted to, weighted like the fit."""
    total = weights.sum().clamp_min(1e-12)
    called = (p >= threshold).to(p)
    ends, others = weights * label, weights * (1 - label)
    clamped = p.clamp(1e-6, 1 - 1e-6)
    loss = -(label * clamped.log() + (1 - label) * (1 - clamped).log())
    which = (p * BINS).long().clamp(0, BINS - 1)  # NaN, a negative whole number, stays NaN in p
    gap = torch.zeros(BINS).to(p).index_add(0, which, weights * (label - p))
    return {
        "model/ends_loss": float((weights * loss).sum() / total),
        "model/ends_calibration": float(gap.abs().sum() / total),
        "model/ends_caught": float((ends * called).sum() / ends.sum().clamp_min(1e-12)),
        "model/ends_false": float((others * called).sum() / others.sum().clamp_min(1e-12)),
    }
