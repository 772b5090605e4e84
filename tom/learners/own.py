"""Learners of plug-ins, whose answers are checked before a model is fitted with them."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tom.data.sampling import normalise
from tom.data.transitions import TensorTransitions
from tom.envs.user_code import running
from tom.errors import OwnCodeError
from tom.learners.base import DEGENERATE, FitContext, Learner, Weighting, uniform
from tom.learners.terms import Terms
from tom.metrics import OURS

OPTIONAL = ("per_dim", "log_ratio")
"""arrays that an answer may lack"""
METHODS = ("weigh", "state_dict", "load_state_dict")
UNIT_MEAN = 1e-3
"""weights whose mean differs from 1 by more are divided by it"""
COUNT = "weights/degenerate"
"""the metric of that name, and its place in a learner's state"""
SINGLE = (type(None), bool, int, float, str, bytes, Tensor, torch.nn.Parameter)
SEVERAL = (list, tuple, set)
NAMED = (dict, OrderedDict)
"""exact types that a checkpoint may hold: numpy's numbers, which are floats too, are not loaded"""


class OwnLearner:
    """A plug-in's learner. Weights that cannot be used become uniform, as those of our learners."""

    def __init__(self, name: str, make: Callable[[], Learner]) -> None:
        """Raises OwnCodeError if `make` fails or makes no learner."""
        self._what = f"learner '{name}'"
        with running(self._what):
            self._learner = make()
        lacking = [m for m in METHODS if not callable(getattr(self._learner, m, None))]
        if lacking:
            raise OwnCodeError(
                f"{self._what} is a {type(self._learner).__name__} without {', '.join(lacking)}: "
                "make must return a learner (docs/extend.md)"
            )
        self._degenerate = 0
        self.state_dict()  # a state that no checkpoint can hold is found here, not at the resume

    def weigh(self, context: FitContext) -> Weighting:
        """Raises OwnCodeError if the learner fails or its answer is of another form."""
        before = _changes(context)
        with running(self._what):
            given = self._learner.weigh(context)
        if _changes(context) != before:
            raise OwnCodeError(
                f"{self._what} changes the replay buffer, which is the training's own: let it "
                "change a copy (clone)"
            )
        self.state_dict()  # it may have another form after the first fit
        answer = self._formed(given, context.replay)
        if not _usable(answer):
            self._degenerate += 1
            plain = uniform(context.replay, ready=False)
            answer = replace(plain, metrics=answer.metrics, notices=(*answer.notices, DEGENERATE))
        if self._degenerate:
            answer = replace(answer, metrics={**answer.metrics, COUNT: float(self._degenerate)})
        return self._of_mean_one(answer)

    def state_dict(self) -> dict[str, Any]:
        with running(self._what):
            state = self._learner.state_dict()
        if not isinstance(state, dict):
            raise OwnCodeError(
                f"{self._what}: state_dict must return a dict ({{}} if it keeps nothing), not a "
                f"{type(state).__name__}"
            )
        if found := _not_loadable(state, "state_dict()"):
            raise OwnCodeError(
                f"{self._what}: {found}, which no checkpoint could be loaded with: keep tensors "
                "(torch.from_numpy), Python's own numbers, texts, lists and dicts of them"
            )
        return {**state, COUNT: self._degenerate} if self._degenerate else state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._degenerate = int(state.get(COUNT, 0))
        with running(self._what):
            self._learner.load_state_dict({k: v for k, v in state.items() if k != COUNT})

    def _formed(self, given: object, replay: TensorTransitions) -> Weighting:
        """`given` with all parts of the right form, and arrays of the right type and device."""
        if not isinstance(given, Weighting):
            raise OwnCodeError(
                f"{self._what} answers with a {type(given).__name__}: weigh must return a Weighting"
            )
        rows, dims = replay.obs.shape
        return replace(
            given,
            weights=self._array("weights", given.weights, (rows,), replay.obs),
            per_dim=self._array("per_dim", given.per_dim, (rows, dims), replay.obs),
            log_ratio=self._array("log_ratio", given.log_ratio, (rows,), replay.obs),
            terms=self._terms(given.terms, replay.obs),
            metrics=self._metrics(given.metrics),
            notices=self._notices(given.notices),
        )

    def _terms(self, given: object, like: Tensor) -> Terms | None:
        if given is None:
            return None
        if not isinstance(given, Terms):
            raise OwnCodeError(
                f"{self._what}: terms must be Terms (tom.learners.terms) or None, not "
                f"{type(given).__name__}"
            )
        shape, parts = (len(like),), vars(given)
        return Terms(*(self._array(f"terms.{n}", parts[n], shape, like) for n in Terms.named()))

    def _metrics(self, given: object) -> dict[str, float]:
        if not isinstance(given, Mapping):
            raise OwnCodeError(
                f"{self._what}: metrics must be numbers by name (a dict), not "
                f"{type(given).__name__}"
            )
        return {name: self._number(name, value) for name, value in given.items()}

    def _notices(self, given: object) -> tuple[tuple[str, str], ...]:
        several = isinstance(given, list | tuple)
        wrong = [one for one in given if not _is_notice(one)] if several else [given]
        if not several or wrong:
            raise OwnCodeError(
                f"{self._what}: notices must be pairs of texts (kind, message), not "
                f"{_shown(wrong[0])}"
            )
        return tuple((kind, message) for kind, message in given)

    def _array(self, name: str, given: Any, shape: tuple[int, ...], like: Tensor) -> Any:
        if given is None and name in OPTIONAL:
            return None
        if not isinstance(given, Tensor) or tuple(given.shape) != shape:
            has = tuple(given.shape) if isinstance(given, Tensor) else type(given).__name__
            raise OwnCodeError(f"{self._what}: {name} must be a tensor of shape {shape}, not {has}")
        return given.detach().to(like)

    def _number(self, name: object, value: Any) -> float:
        if not isinstance(name, str):
            raise OwnCodeError(
                f"{self._what}: the name of its metric {_shown(name)} must be a text"
            )
        if name in OURS:
            raise OwnCodeError(
                f"{self._what}: its metric '{name}' is one that the training records itself: give "
                "it another name"
            )
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            said = f"{self._what}: its metric '{name}' is {_shown(value)} and must be one number"
            raise OwnCodeError(said) from None

    def _of_mean_one(self, answer: Weighting) -> Weighting:
        mean = float(answer.weights.mean(dtype=torch.float64))
        if abs(mean - 1) <= UNIT_MEAN:
            return answer
        scale = 1 / mean
        said = f"the weights of {self._what} have mean {mean:.3g}: they are divided by it"
        return replace(
            answer,
            weights=normalise(answer.weights)[0],
            per_dim=None if answer.per_dim is None else answer.per_dim * scale,
            notices=(*answer.notices, ("weights-scaled", said)),
        )


def _changes(context: FitContext) -> list[int]:
    """How often each tensor of the buffers was changed in place."""
    buffers = context.replay, context.policy_buffer
    tensors = [tensor for rows in buffers for tensor in vars(rows).values()]
    return [tensor._version for tensor in tensors if not tensor.is_inference()]


def _not_loadable(state: Any, where: str) -> str | None:
    """The first part of a learner's state that a checkpoint would not be loaded with, if any."""
    kind = type(state)
    if kind in SINGLE:
        return None
    if kind in NAMED:
        parts = [(f"{where}[{name!r:.40}]", part) for name, part in state.items()]
        parts += [(f"a key of {where}", name) for name in state]
    elif kind in SEVERAL:
        parts = [(f"{where}[{i}]", part) for i, part in enumerate(state)]
    else:
        return f"{where} is a {kind.__module__}.{kind.__qualname__}"
    found = (_not_loadable(part, place) for place, part in parts)
    return next((each for each in found if each), None)


def _is_notice(given: object) -> bool:
    if not isinstance(given, list | tuple):
        return False
    return len(given) == 2 and all(isinstance(part, str) for part in given)


def _shown(given: object) -> str:
    """The beginning of a value in one line."""
    return " ".join(repr(given).split())[:40]


def _usable(answer: Weighting) -> bool:
    """Whether all weights are finite and at least zero, and some are above."""
    parts = [part for part in (answer.weights, answer.per_dim) if part is not None]
    return all(
        bool(part.isfinite().all() and (part >= 0).all() and part.sum() > 0) for part in parts
    )
