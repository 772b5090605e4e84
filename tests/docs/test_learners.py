"""docs/learners/: what stands there of the gallery's runs is what they recorded."""

import re
from pathlib import Path

import numpy as np
import pytest

from tom.analysis import statistics
from tom.record import RunReader, Store

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/learners/mle.md").read_text()
EXPLORATION, ON_POLICY, EVERY = 5_000, 15_000, 1_000
OTHERS = {"model.hidden": "200", "model.uniform_share": "0.0", "rollout.uniform_share": "0.0"}
"""without the small models, and the runs with weights in one place alone"""


@pytest.mark.parametrize(("label", "learner"), [("MLE", "mle"), ("TOM", "tom")])
def test_our_runs_beside_the_released_code(label: str, learner: str) -> None:
    runs = [
        run
        for run in Store(ROOT / "runs").runs()
        if (run.env, run.learner, run.preset) == ("hopper", learner, "paper")
        if all(run.settings[path] == value for path, value in OTHERS.items())
    ]
    curves = [returns(run) for run in sorted(runs, key=lambda run: run.seed)]
    means = np.array([curve.mean() for curve in curves])
    spread = statistics.interval(means[:, None], statistics.mean, statistics.draws())
    (line,) = re.findall(rf"^\| {label} \| (.*) \|$", PAGE, re.MULTILINE)
    assert line.split(" | ") == [
        f"{spread.value:.0f} [{spread.low:.0f}, {spread.high:.0f}]",
        whole(means),
        whole([curve.max() for curve in curves]),
        whole([curve[-1] for curve in curves]),
        whole([episodes(run) for run in sorted(runs, key=lambda run: run.seed)]),
    ]


def recorded(run: RunReader, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """On-policy steps and values, (N,) each, to step 15 000."""
    rows = run.metrics()[["env_step", metric]].dropna().to_numpy()
    step = rows[:, 0] - EXPLORATION
    among = (step > 0) & (step <= ON_POLICY)
    return step[among], rows[among, 1]


def returns(run: RunReader) -> np.ndarray:
    """Fifteen evaluations, (15,)."""
    step, value = recorded(run, "eval/return")
    assert step.tolist() == list(range(EVERY, ON_POLICY + 1, EVERY))
    return value


def episodes(run: RunReader) -> float:
    """The median over stretches of the mean length of the training episodes that ended there."""
    step, length = recorded(run, "train/length")
    stretch = (step - 1) // EVERY
    return float(np.median([length[stretch == i].mean() for i in np.unique(stretch)]))


def whole(values: object) -> str:
    return ", ".join(f"{value:.0f}" for value in np.asarray(values))
