"""Stopping a network's training where its loss on held-out rows is least."""

from collections.abc import Callable
from copy import deepcopy

from tom.config import TomConfig
from tom.nn.mlp import StackedMLP


class Validation:
    """Looks at a moving network's held-out loss now and then; keeps the network of the least.

    A training is over after `q_patience` looks without a new least loss.
    """

    def __init__(
        self, net: StackedMLP, loss: Callable[[StackedMLP], float], config: TomConfig
    ) -> None:
        self._net, self._loss, self._config = net, loss, config
        self._best = net
        self._least, self._kept_at, self._idle = float("inf"), 0, 0
        self.steps = 0  # of the training until it was over

    @property
    def over(self) -> bool:
        return self._idle >= self._config.q_patience

    def look(self, step: int) -> bool:
        """Judge the network where a look is due; whether its training is over."""
        if not self.over:
            self.steps = step
            if step % self._config.q_check_every == 0 or step == self._config.q_steps:
                self._judge(step)
        return self.over

    def best(self) -> StackedMLP:
        """The network of the least held-out loss; the last one where no loss was a number."""
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
