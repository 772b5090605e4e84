"""Learners of plug-ins, whose answers are checked before a model is fitted with them."""

import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tom.data.sampling import normalise
from tom.envs.user_code import running_user_code
from tom.errors import OwnCodeError, reason
from tom.learners.base import DEGENERATE, FitContext, Learner, Weighting, uniform
from tom.learners.terms import Terms
from tom.metrics import BUILT_IN

UNIT_MEAN = 1e-3
"""weights whose mean differs from 1 by more are divided by it"""


class OwnLearner:
    """A plug-in's learner. Weights that cannot be used become uniform, as those of our learners."""

    def __init__(self, name: str, make: Callable[[], Learner]) -> None:
        """Raises OwnCodeError if `make` fails or makes no learner."""
        self._what = f"learner '{name}'"
        with running_user_code(self._what):
            self._learner = make()
        self.state_dict()  # a state that no checkpoint can hold is found here, not at the resume

    def weigh(self, context: FitContext) -> Weighting:
        """Raises OwnCodeError if the learner fails or its answer is of another form."""
        with running_user_code(self._what):
            given = self._learner.weigh(context)
            if not isinstance(given, Weighting):
                raise OwnCodeError(
                    f"{self._what} answers with a {type(given).__name__}: weigh must return a "
                    "Weighting"
                )
            answer = self._checked_types(given, context.replay.obs)
        self.state_dict()  # it may have another form after the first fit
        if not _is_usable(answer):
            plain = uniform(context.replay, ready=False)
            answer = replace(plain, metrics=answer.metrics, notices=(*answer.notices, DEGENERATE))
        return self._scaled_to_mean_one(answer)

    def state_dict(self) -> dict[str, Any]:
        """The learner's own. Raises OwnCodeError if no checkpoint could be loaded with it."""
        with running_user_code(self._what):
            state = self._learner.state_dict()
            if not isinstance(state, dict):
                raise OwnCodeError(
                    f"{self._what}: state_dict must return a dict ({{}} if it keeps nothing), not "
                    f"a {type(state).__name__}"
                )
        file = io.BytesIO()
        try:
            torch.save(state, file)
            file.seek(0)
            torch.load(file, weights_only=True)
        except Exception as error:  # pickle's and torch's share no class
            raise OwnCodeError(
                f"{self._what}: no checkpoint could be loaded with its state_dict: keep tensors "
                "(torch.from_numpy), Python's own numbers, texts, lists and dicts of them "
                f"({reason(error)})"
            ) from error
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        with running_user_code(self._what):
            self._learner.load_state_dict(state)

    def _checked_types(self, given: Weighting, obs: Tensor) -> Weighting:
        """`given` with arrays like obs (N, O) and plain numbers and texts."""

        def array(name: str, value: Any, shape: tuple[int, ...] = obs.shape[:1]) -> Tensor:
            if not isinstance(value, Tensor) or value.shape != shape:
                has = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise OwnCodeError(
                    f"{self._what}: {name} must be a tensor of shape {tuple(shape)}, not {has}"
                )
            return value.detach().to(obs)

        metrics = {str(name): float(value) for name, value in given.metrics.items()}
        if taken := metrics.keys() & BUILT_IN:
            raise OwnCodeError(
                f"{self._what}: its metric '{min(taken)}' is one that the training records itself: "
                "give it another name"
            )
        ratio, terms = given.log_ratio, given.terms
        return replace(
            given,
            weights=array("weights", given.weights),
            per_dim=None if given.per_dim is None else array("per_dim", given.per_dim, obs.shape),
            log_ratio=None if ratio is None else array("log_ratio", ratio),
            terms=terms and Terms(*(array(f"terms.{n}", getattr(terms, n)) for n in Terms.named())),
            metrics=metrics,
            notices=tuple((str(kind), str(message)) for kind, message in given.notices),
        )

    def _scaled_to_mean_one(self, answer: Weighting) -> Weighting:
        mean = float(answer.weights.mean(dtype=torch.float64))
        if abs(mean - 1) <= UNIT_MEAN:
            return answer
        message = f"the weights of {self._what} have mean {mean:.3g}: they are divided by it"
        return replace(
            answer,
            weights=normalise(answer.weights)[0],
            per_dim=None if answer.per_dim is None else answer.per_dim * (1 / mean),
            notices=(*answer.notices, ("weights-scaled", message)),
        )


def _is_usable(answer: Weighting) -> bool:
    """Whether all weights are finite and at least zero, and some are above."""
    parts = [part for part in (answer.weights, answer.per_dim) if part is not None]
    return all(
        bool(part.isfinite().all() and (part >= 0).all() and part.sum() > 0) for part in parts
    )
