"""When nothing is heard of a training any more: 60 s of silence, and no heartbeat."""

import time

import pytest
from ray.exceptions import ActorDiedError, ActorUnavailableError

from tom.record.status import Status
from tom.sweep.ray_engine import ended_by
from tom.sweep.watchdog import LOST_AFTER_S, Watchdog, lost

DEAD = Status("running", heartbeat=0.0)


@pytest.mark.parametrize("status", [DEAD, Status("failed"), Status()])
def test_a_silent_machine_without_a_heartbeat_is_lost_after_a_minute(status: Status):
    assert LOST_AFTER_S == 60
    assert lost(59.9, status) is None
    ended = lost(60.0, status)
    assert ended is not None
    assert ended.code is None
    assert "for 60 s" in ended.why


def test_a_heart_that_beats_is_proof_of_life():
    assert lost(1e6, Status("running", heartbeat=time.time())) is None


def test_silence_is_counted_from_the_last_word_on():
    now = 100.0
    watchdog = Watchdog(lambda: now)
    now = 200.0  # waits for a free core
    assert (watchdog.started, watchdog.silent_s) == (False, 0.0)
    watchdog.reset()
    now = 259.5
    assert (watchdog.started, watchdog.silent_s) == (True, 59.5)
    watchdog.reset()
    assert watchdog.silent_s == 0.0


def test_a_machine_that_may_answer_later_has_not_ended_and_a_dead_one_has():
    assert ended_by(ActorUnavailableError("no answer", None)) is None
    ended = ended_by(ActorDiedError())
    assert ended is not None
    assert ended.code is None
    assert "died" in ended.why
