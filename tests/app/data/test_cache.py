"""Results are made once a version, and the ones used last are kept within a budget of bytes."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import pandas as pd
import pytest
import torch

from app.data import cache
from app.data.cache import RESULTS, bytes_of, get_or_make
from tom.data.transitions import Transitions


@pytest.fixture(autouse=True)
def room(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A budget of 10 000 bytes."""
    small = type(RESULTS)(10_000, lambda held: min(bytes_of(held[1]), 10_000))
    monkeypatch.setattr(cache, "RESULTS", small)
    yield
    assert small.currsize <= 10_000


def test_of_what_changes_one_version_is_kept() -> None:
    for version in range(3):
        assert get_or_make(("live",), version, lambda v=version: [v]) == [version]
    assert get_or_make(("still",), None, lambda: [9]) == [9]
    assert get_or_make(("live",), 2, lambda: [0]) == [2]
    assert get_or_make(("live",), 1, lambda: [0]) == [0]


def test_what_one_thread_makes_another_waits_for() -> None:
    begun, go_on = Event(), Event()

    def make() -> list[int]:
        begun.set()
        assert go_on.wait(30)
        return [1]

    with ThreadPoolExecutor(3) as threads:
        first = threads.submit(get_or_make, ("a",), None, make)
        assert begun.wait(30)
        second = threads.submit(get_or_make, ("a",), None, lambda: [2])
        assert threads.submit(get_or_make, ("b",), None, lambda: [3]).result(30) == [3]
        go_on.set()
        assert second.result(30) is first.result(30)


def test_all_results_share_the_bytes_and_the_oldest_goes_first() -> None:
    first = get_or_make(("a",), None, lambda: np.zeros(500))
    get_or_make(("b",), None, lambda: np.zeros(500))
    assert get_or_make(("a",), None, lambda: np.ones(500)) is first  # now `b` is the oldest
    get_or_make(("c",), None, lambda: np.zeros(500))
    assert get_or_make(("a",), None, lambda: np.ones(500)) is first
    assert get_or_make(("b",), None, lambda: np.ones(500)).all()


def test_a_result_larger_than_the_budget_is_kept_alone() -> None:
    large = get_or_make(("large",), None, lambda: np.zeros(2000))
    assert get_or_make(("large",), None, lambda: np.ones(2000)) is large
    small = get_or_make(("small",), None, lambda: np.zeros(2))
    assert get_or_make(("small",), None, lambda: np.ones(2)) is small
    assert get_or_make(("large",), None, lambda: np.ones(2000)).all()


@pytest.mark.parametrize(
    ("value", "size"),
    [
        ([np.zeros(100), {"a": np.zeros(50)}], 1200),
        (pd.DataFrame({"a": np.zeros(1000)}), 8000),
        (Transitions(*[np.zeros((10, 100), np.float32)] * 6), 4000),
        (torch.nn.Linear(100, 100), 40_400),
        (torch.zeros(7, 100), 2800),
    ],
)
def test_results_are_weighed_with_all_that_lies_in_them(value: object, size: int) -> None:
    assert size <= bytes_of(value) <= size + 2000
    assert bytes_of((value, value)) < size + 2100  # once
