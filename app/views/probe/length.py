"""Runs of comparable length: a run that was stopped early must not set the scale."""

from collections.abc import Sequence

import numpy as np

from tom.record.reader import RunReader

FACTOR = 2.0
"""a run is like the others if it has between half and twice their median number of steps"""


def of_like_length(runs: Sequence[RunReader]) -> tuple[list[RunReader], list[RunReader]]:
    """The runs of about the usual length, and the others."""
    if not runs:
        return [], []
    usual = float(np.median([run.status.env_step for run in runs]))
    like = [usual / FACTOR <= run.status.env_step <= usual * FACTOR for run in runs]
    kept = [run for run, is_like in zip(runs, like, strict=True) if is_like]
    return kept, [run for run, is_like in zip(runs, like, strict=True) if not is_like]
