"""A command that starts trainings is killed: none of them goes on without it."""

import signal
from pathlib import Path

import pytest
from faults import ended, tom, wait_until

from tom.record import Store

pytestmark = pytest.mark.fault


def under_way(store: Path) -> bool:
    return any(run.status.alive and run.status.env_step > 0 for run in Store(store).runs())


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_tom_demo_is_killed__its_trainings_end(tmp_path: Path, number: signal.Signals):
    process = tom("demo", "--headless", "--store", tmp_path)
    wait_until(lambda: under_way(tmp_path))
    process.send_signal(number)
    wait_until(lambda: not any(run.status.alive for run in Store(tmp_path).runs()))
    assert ended(process)[0] == (0 if number is signal.SIGTERM else -signal.SIGKILL)
