"""ReplayBuffer against a plain list of rows."""

from collections.abc import Iterable
from math import nan

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions

OBS_DIM, ACTION_DIM = 3, 2


def rows(start: int, n: int) -> TensorTransitions:
    """n recognisable transitions numbered from `start`."""
    k = torch.arange(start, start + n, dtype=torch.float32)
    obs = k[:, None] * 10 + torch.arange(OBS_DIM)
    action = -k[:, None] - torch.arange(ACTION_DIM) / 8
    return TensorTransitions(
        obs, action, k / 4, obs + 10, (k % 3 == 0).float(), (k % 5 == 0).float()
    )


def equal(left: TensorTransitions, right: TensorTransitions) -> bool:
    names = ("obs", "action", "reward", "next_obs", "terminated", "truncated")
    return all(torch.equal(getattr(left, n), getattr(right, n)) for n in names)


def behaviour(numbers: Iterable[int]) -> torch.Tensor:
    """Recognisable Gaussians; every third is not known."""
    each = [[nan if k % 3 == 0 else k + i for i in range(2 * ACTION_DIM)] for k in numbers]
    return torch.tensor(each, dtype=torch.float32).view(-1, 2 * ACTION_DIM)


def add_one(buffer: ReplayBuffer, t: TensorTransitions, version: int) -> None:
    n = t.numpy()
    buffer.add(
        np.asarray(n.obs[0], dtype=np.float64),
        np.asarray(n.action[0]),
        float(n.reward[0]),
        np.asarray(n.next_obs[0]),
        bool(n.terminated[0]),
        bool(n.truncated[0]),
        version,
        None if version % 3 == 0 else behaviour([version])[0].numpy(),
    )


operation = st.one_of(
    st.tuples(st.just("add"), st.just(1)),
    st.tuples(st.just("extend"), st.integers(0, 25)),
    st.tuples(st.just("clear"), st.just(0)),
    st.tuples(st.just("reload"), st.just(0)),
    st.tuples(st.just("resize"), st.integers(1, 12)),
)


@settings(max_examples=150, deadline=None)
@given(capacity=st.integers(1, 12), operations=st.lists(operation, max_size=12), data=st.data())
def test_behaves_as_a_list(capacity, operations, data):
    buffer = ReplayBuffer(capacity, OBS_DIM, ACTION_DIM, keeps_behaviour=True)
    model: list[int] = []  # numbers of the rows held, oldest first
    total = 0
    for kind, n in operations:
        if kind == "clear":
            buffer.clear()
            model = []
        elif kind == "reload":
            state = buffer.state_dict()
            buffer = ReplayBuffer(capacity, OBS_DIM, ACTION_DIM, keeps_behaviour=True)
            buffer.load_state_dict(state)
        elif kind == "resize":
            buffer.resize(n)
            capacity, model = n, model[-n:]
        elif kind == "add":
            add_one(buffer, rows(total, 1), total)
        else:
            new = torch.arange(total, total + n)
            buffer.extend(rows(total, n), new, behaviour(range(total, total + n)))
        if kind in ("add", "extend"):
            model = (model + list(range(total, total + n)))[-capacity:]
            total += n
        assert len(buffer) == len(model)
        assert buffer.total_added == total
    held = rows(0, total)[torch.tensor(model, dtype=torch.int64)]
    assert equal(buffer.transitions(), held)
    assert buffer.policy_version().tolist() == model
    np.testing.assert_array_equal(buffer.behaviour(), behaviour(model))
    n = data.draw(st.integers(0, capacity + 2))
    newest = held[max(len(model) - n, 0) :]
    assert equal(buffer.last(n), newest)
    tail = buffer.tail(n)
    assert equal(TensorTransitions.unpack(tail["rows"], OBS_DIM, ACTION_DIM), newest)
    assert tail["policy_version"].tolist() == model[max(len(model) - n, 0) :]
    mark = data.draw(st.integers(0, total))
    newer = [position for position, k in enumerate(model) if k >= mark]
    assert equal(buffer.since(mark), held[torch.tensor(newer, dtype=torch.int64)])
    if model:
        index = torch.tensor(data.draw(st.lists(st.integers(0, len(model) - 1), max_size=8)))
        assert equal(buffer.gather(index.long()), held[index.long()])
