"""A plug-in's learner: its answers are checked, and weights that cannot be used are uniform."""

from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
import torch
from common import generator, reloaded
from made import OBS, context, rows

from tom.data.sampling import normalise
from tom.errors import DivergedError, OwnCodeError
from tom.learners.base import Weighting
from tom.learners.own import OwnLearner
from tom.learners.terms import Terms

N = 50


class Answering:
    """Answers with what it was given, or raises it."""

    def __init__(self, answer: Any, state: Any = None) -> None:
        self.answer = answer
        self.state = {"mine": 1} if state is None else state

    def weigh(self, context: Any) -> Any:
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer

    def state_dict(self) -> dict[str, Any]:
        return self.state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


def own(answer: Any) -> OwnLearner:
    return OwnLearner("mine", lambda: Answering(answer))


def weights(**changed: float) -> torch.Tensor:
    """Random ones of mean 1, with the first ones replaced."""
    drawn = normalise(torch.rand(N, generator=generator()))[0]
    for row, value in enumerate(changed.values()):
        drawn[row] = value
    return drawn


def test_a_right_answer_is_left_as_it_is():
    given = Weighting(weights(), weights()[:, None].expand(N, OBS), weights(), metrics={"a": 2.0})
    found = own(given).weigh(context(rows(N)))
    for name in ("weights", "per_dim", "log_ratio"):
        assert torch.equal(getattr(found, name), getattr(given, name))
    assert (found.metrics, found.notices, found.ready) == ({"a": 2.0}, (), True)


@pytest.mark.parametrize(
    "given",
    [
        Weighting(weights(a=float("nan"))),
        Weighting(weights(a=-0.5)),
        Weighting(torch.zeros(N)),
        Weighting(weights(), per_dim=torch.full((N, OBS), float("nan"))),
    ],
)
def test_weights_that_cannot_be_used_are_uniform(given: Weighting):
    found = own(given).weigh(context(rows(N)))
    assert torch.equal(found.weights, torch.ones(N))
    assert (found.per_dim, found.ready) == (None, False)
    assert found.notices[0][0] == "degenerate-weights"


def test_weights_of_another_type_or_mean_are_brought_to_ours():
    wanted = weights()
    grown = wanted.double().mul(7).requires_grad_()
    found = own(Weighting(grown, metrics={"a": torch.tensor(2)})).weigh(  # pyright: ignore[reportArgumentType]
        context(rows(N))
    )
    torch.testing.assert_close(found.weights, wanted)
    assert (found.weights.dtype, found.weights.requires_grad) == (torch.float32, False)
    assert found.metrics == {"a": 2.0}
    assert "mean 7" in dict(found.notices)["weights-scaled"]


def test_a_metric_named_like_one_that_the_training_records_is_refused_by_name():
    name = "eval/return"
    with pytest.raises(OwnCodeError, match=name):
        own(Weighting(weights(), metrics={name: 7.0})).weigh(context(rows(N)))


@pytest.mark.parametrize(
    ("answer", "named"),
    [
        (None, "NoneType"),
        (Weighting(weights()[:-3]), r"weights .* \(50,\), not \(47,\)"),
        (Weighting(weights(), per_dim=torch.ones(N)), r"per_dim .* \(50, 3"),
        (Weighting(weights(), metrics={"a": "b"}), "ValueError"),  # pyright: ignore[reportArgumentType]
        (KeyError("nope"), r"learner 'mine' fails: KeyError: 'nope' \(test_own.py, line"),
        (SystemExit(0), "learner 'mine' fails: SystemExit"),
    ],
)
def test_another_answer_is_one_line_that_names_the_learner(answer: Any, named: str):
    with pytest.raises(OwnCodeError, match=named) as found:
        own(answer).weigh(context(rows(N)))
    assert "learner 'mine'" in str(found.value)
    assert "\n" not in str(found.value)


def test_notices_and_terms_of_the_right_form_are_recorded_as_ours():
    terms = Terms(*(weights().requires_grad_() for _ in range(4)))
    given = Weighting(weights(), terms=terms, notices=[["kind", "words"]])  # pyright: ignore[reportArgumentType]
    found = own(given).weigh(context(rows(N)))
    assert found.notices == (("kind", "words"),)
    assert found.event(1).terms.keys() == terms.recorded().keys()


def test_errors_that_explain_themselves_stay():
    for error in (DivergedError("step 3: a loss"), MemoryError(), KeyboardInterrupt()):
        with pytest.raises(type(error)):
            own(error).weigh(context(rows(N)))


def test_a_state_that_no_checkpoint_can_hold_is_refused_before_or_at_its_fit():
    state = {"mean": np.ones(3)}
    with pytest.raises(OwnCodeError, match="state_dict"):
        OwnLearner("mine", lambda: Answering(None, state))
    learner = Answering(Weighting(weights()))
    made = OwnLearner("mine", lambda: learner)
    learner.state = state
    with pytest.raises(OwnCodeError, match="state_dict"):
        made.weigh(context(rows(N)))


def test_a_state_that_is_accepted_is_loaded_as_a_checkpoint_is():
    net = torch.nn.Linear(2, 2)
    state = {
        "net": net.state_dict(),
        "adam": torch.optim.Adam(net.parameters()).state_dict(),
        "rest": [1, 2.0, None, True, "a", b"b", (1, {2}), OrderedDict(a=torch.ones(2))],
        "own": torch.nn.Parameter(torch.ones(2)),
    }
    loaded = reloaded(OwnLearner("mine", lambda: Answering(None, state)).state_dict())
    assert loaded["rest"][:-1] == state["rest"][:-1]
    assert torch.equal(loaded["net"]["weight"], net.weight)
