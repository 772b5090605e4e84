"""Early stopping of a network's training at the minimum of its held-out loss."""

from collections.abc import Callable
from copy import deepcopy

from tom.config import TomConfig
from tom.nn.mlp import StackedMLP


class Validation:
    """Evaluates a network's held-out loss from time to time; keeps the network with the lowest.

    A training is over after `q_patience` evaluations without a new minimum.
    """

    def __init__(
        self, net: StackedMLP, loss: Callable[[StackedMLP], float], config: TomConfig
    ) -> None:
        self._net, self._loss, self._config = net, loss, config
        self._best = net
        self._least, self._kept_at, self._idle = float("inf"), 0, 0
        self.steps = 0  # training steps until it was over

    @property
    def over(self) -> bool:
        return self._idle >= self._config.q_patience

    def look(self, step: int) -> bool:
        """Evaluate the network if it is due; returns whether its training is over."""
        if not self.over:
            self.steps = step
            if step % self._config.q_check_every == 0 or step == self._config.q_steps:
                self._judge(step)
        return self.over

    def best(self) -> StackedMLP:
        """The network with the lowest held-out loss; the last one if every loss was NaN."""
        return self._best

    @property
    def metrics(self) -> dict[str, float]:
        return {"dual/holdout_loss": self._least, "dual/steps": float(self._kept_at)}

    def _judge(self, step: int) -> None:
        loss = self._loss(self._net)
        self._idle += 1
        if loss < self._least:
            self._best = deepcopy(self._net).requires_grad_(False)
            self._least, self._kept_at, self._idle = loss, step, 0
