"""What a running sweep shows, on a terminal and in a log."""

import io
from pathlib import Path

import pytest
from common import recorded

from tom.cli.sweep import SweepDisplay
from tom.events import Tick
from tom.record import Store
from tom.sweep.driver import Driver, FolderBackend
from tom.sweep.engine import LocalEngine
from tom.training.plan import checked, trials

PLAN = {"env": "hopper", "learner": ["mle", "tom"], "seeds": [0, 1], "steps": 6_000}


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Driver:
    """Four runs of which one is finished and one has failed."""
    for name, value in (("COLUMNS", "160"), ("LINES", "24"), ("TERM", "xterm")):
        monkeypatch.setenv(name, value)
    first, *others = trials(checked(PLAN))
    store = Store(tmp_path)
    recorded(store, first.run_id, first.config, [Tick(6_000, "optimise")])
    found = Driver(FolderBackend(store), [first, *others], LocalEngine(1))
    found.jobs[2].state, found.jobs[2].note = "failed", "no memory\nand what came before"
    return found


def shown(driver: Driver, stream: io.StringIO) -> str:
    with SweepDisplay(driver, stream) as display:
        display.update()
    return stream.getvalue()


def test_the_live_table_has_every_run(driver: Driver):
    text = shown(driver, Terminal())
    assert all(job.run_id in text for job in driver.jobs)
    assert "was there already" in text
    assert "no memory" in text
    assert "and what came before" not in text  # that is reported at the end
    assert "1 failed, 2 waiting, 1 finished" in text


def test_where_the_terminal_is_small_what_matters_is_shown_and_the_rest_counted(
    driver: Driver, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("LINES", "11")
    text = shown(driver, Terminal())
    assert driver.jobs[2].run_id in text  # the failed one
    assert driver.jobs[0].run_id not in text  # the finished one
    assert "1 more not shown" in text


def test_in_a_log_a_line_is_a_change(driver: Driver):
    stream = io.StringIO()
    with SweepDisplay(driver, stream) as display:
        display.update()
        display.update()
        driver.jobs[1].state = "running"
        display.update()
    lines = stream.getvalue().splitlines()
    assert lines[0] == f"{driver.jobs[0].run_id}: finished (was there already)"
    assert [line.split(": ")[1] for line in lines if driver.jobs[1].run_id in line] == [
        "waiting",
        "running",
    ]
    assert lines.count("1 failed, 2 waiting, 1 finished") == 1
