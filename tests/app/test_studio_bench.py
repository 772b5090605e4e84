"""The store that `tom bench studio` measures with."""

from pathlib import Path

import pytest

from app import readers
from app.bench import LEARNERS, METRICS, POINTS, make_store


@pytest.mark.slow
def test_the_store_is_as_large_as_the_measurement_says(tmp_path: Path) -> None:
    make_store(tmp_path, 6)
    listing = readers.listing(str(tmp_path))
    assert listing.problems == ()
    assert {(run.learner, run.seed) for run in listing.runs} == {
        *((learner, 0) for learner in LEARNERS),
        *((learner, 1) for learner in LEARNERS[:2]),
    }
    for run in listing.runs:
        assert readers.metrics(run).shape == (POINTS, METRICS + 1)
        assert len(readers.profiles(run).env_step) == POINTS
        assert readers.problems(run) == []
