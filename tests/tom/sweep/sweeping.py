"""A small sweep, driven to its end and compared with another."""

import time
from collections.abc import Callable

import pandas as pd
from same_records import untimed

from tom.record import RunReader, Store, checkpoint
from tom.sweep.driver import Driver
from tom.training.plan import Trial, checked, trials

STEPS, EVERY = 500, 100
PLAN = {
    "env": ["inverted-pendulum"],
    "learner": ["mle", "pmac", "tom"],
    "seeds": [0, 1],
    "steps": STEPS,
    "preset": "smoke",
    "settings": {"checkpoint_every": EVERY},
}
WAIT_S = 240.0


def plan(**changes) -> list[Trial]:
    return trials(checked({**PLAN, **changes}))


def until(done: Callable[[], object], poll: Callable[[], object] = lambda: None) -> None:
    """Poll until `done`; fails after WAIT_S."""
    end = time.monotonic() + WAIT_S
    while not done():
        assert time.monotonic() < end, "this never happened"
        poll()
        time.sleep(0.1)


def finish(driver: Driver) -> None:
    until(driver.poll)
    driver.stop()


def assert_same_runs(store: Store, undisturbed: Store) -> None:
    """All runs finished, every number as in peace, to the last bit."""
    found = {run.run_id: run for run in store.runs()}
    assert set(found) == {run.run_id for run in undisturbed.runs()}
    for run_id, run in found.items():
        assert run.status.state == "finished", run_id
        pd.testing.assert_frame_equal(
            untimed(run), untimed(undisturbed.run(run_id)), check_exact=True
        )


def beyond_a_checkpoint(store: Store) -> list[RunReader]:
    """Running, and killed now they would not have to begin anew."""
    return [run for run in store.runs() if run.status.alive and saved(run)]


def saved(run: RunReader) -> int | None:
    return checkpoint.newest(run.path / checkpoint.FOLDER)
