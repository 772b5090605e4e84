"""When nothing is heard of a training any more: 60 s of silence, and no heartbeat."""

import time

import pytest
from ray.exceptions import ActorDiedError, ActorUnavailableError

from tom.record.status import Status
from tom.sweep.ray_engine import ended_by
from tom.sweep.silence import LOST_AFTER_S, Silence, lost

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
    silence = Silence(lambda: now)
    now = 200.0  # waits for a free core
    assert (silence.begun, silence.seconds) == (False, 0.0)
    silence.broken()
    now = 259.5
    assert (silence.begun, silence.seconds) == (True, 59.5)
    silence.broken()
    assert silence.seconds == 0.0


def test_a_machine_that_may_answer_later_has_not_ended_and_a_dead_one_has():
    assert ended_by(ActorUnavailableError("no answer", None)) is None
    ended = ended_by(ActorDiedError())
    assert ended is not None
    assert ended.code is None
    assert "died" in ended.why
