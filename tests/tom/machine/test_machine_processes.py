"""Processes end with the one that started them, unless they are meant to outlive it."""

import os
import signal
import subprocess
import sys

import pytest
from kernel import alive, wait_for

from tom.machine import processes

SLEEP = "import time; print('up', flush=True); time.sleep(600)"
PARENT = """
import subprocess, sys, time
from tom.machine import processes
child = processes.start(
    [sys.executable, "-c", "import time; time.sleep(600)"], subprocess.DEVNULL, outlives=%s
)
print(child.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("outlives", [False, True])
def test_a_child_ends_with_its_starter_unless_it_outlives_it(outlives: bool) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT % outlives], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()  # no chance to end anybody
    parent.wait()
    parent.stdout.close()
    if outlives:
        assert alive(child)
        os.kill(child, signal.SIGKILL)
        return
    wait_for(lambda: not alive(child))


def test_who_does_not_stop_is_killed() -> None:
    stubborn = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + SLEEP
    started = [
        processes.start([sys.executable, "-c", code], subprocess.PIPE) for code in (SLEEP, stubborn)
    ]
    for process in started:
        assert process.stdout is not None
        process.stdout.readline()  # its handler is there
    processes.stop(started, grace_s=0.5)
    assert [process.returncode for process in started] == [-signal.SIGTERM, -signal.SIGKILL]
    for process in started:
        process.stdout.close()  # type: ignore[union-attr]
