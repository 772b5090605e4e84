"""Results are made once, and the ones asked for last are kept."""

import numpy as np
import pandas as pd
import pytest
import torch

from app.data.cache import Room, VersionedCache, bytes_of
from tom.data.transitions import Transitions


def test_a_result_is_made_once_and_the_oldest_is_forgotten() -> None:
    made: list[str] = []

    def make(name: str) -> str:
        made.append(name)
        return name.upper()

    cache: VersionedCache[str] = VersionedCache(2)
    for name in ("a", "b", "a", "c", "a", "b"):
        assert cache.get(name, lambda name=name: make(name)) == name.upper()
    assert made == ["a", "b", "c", "b"]


def test_of_what_changes_one_version_is_kept() -> None:
    cache: VersionedCache[list[int]] = VersionedCache(2)
    for version in range(3):
        assert cache.get("live", lambda v=version: [v], version) == [version]
    assert cache.get("still", lambda: [9]) == [9]
    assert cache.get("live", lambda: [0], 2) == [2]
    assert cache.get("live", lambda: [0], 1) == [0]


def test_all_caches_of_a_room_share_its_bytes_and_the_oldest_goes_first() -> None:
    room = Room(10_000)
    first: VersionedCache[np.ndarray] = VersionedCache(8, room)
    second: VersionedCache[np.ndarray] = VersionedCache(8, room)
    kept = first.get("a", lambda: np.zeros(500))
    second.get("b", lambda: np.zeros(500))
    assert first.get("a", lambda: np.ones(500)) is kept  # now `b` is the oldest
    second.get("c", lambda: np.zeros(500))
    assert room.bytes == 8000
    assert first.get("a", lambda: np.ones(500)) is kept
    assert second.get("b", lambda: np.ones(500)).all()
    assert room.bytes <= room.most


@pytest.mark.fault
@pytest.mark.quick
def test_results_larger_than_all_that_may_be_kept__are_given_and_alone_are_kept() -> None:
    room = Room(10_000)
    cache: VersionedCache[np.ndarray] = VersionedCache(8, room)
    for number in range(100):
        cache.get(number, lambda: np.zeros(2000))
    assert room.bytes == 16_000
    small = cache.get("small", lambda: np.zeros(2))
    assert room.bytes == 16
    assert cache.get("small", lambda: np.ones(2)) is small


def test_what_a_forgotten_cache_held_makes_room() -> None:
    room = Room(10_000)
    VersionedCache[np.ndarray](8, room).get("a", lambda: np.zeros(1000))
    second: VersionedCache[np.ndarray] = VersionedCache(8, room)
    for number in range(5):
        second.get(number, lambda: np.zeros(1000))
    assert room.bytes == 8000
    second.forget(4)
    assert room.bytes == 0


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
