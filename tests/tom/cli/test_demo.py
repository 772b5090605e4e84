"""`tom demo` ends with what its runs have recorded."""

import json
import re
import shutil
from pathlib import Path

import numpy as np

from tom.cli.demo import seen
from tom.record import Store

GALLERY = Path(__file__).parents[3] / "runs"
NAMES = [
    next(path.name for path in sorted(GALLERY.glob(f"hopper-{run}-*")))
    for run in ("mle-s0", "tom-s0", "tom-s1")
]


def at(step: float, curve: list[tuple[int, float]]) -> float:
    """The value of a curve at a step."""
    steps, values = np.array(curve).T
    return float(np.interp(step, steps, values))


def test_it_says_each_learners_mean_return_at_the_step_that_all_reach(tmp_path: Path):
    curves = {}
    for name in NAMES:
        shutil.copytree(GALLERY / name, tmp_path / name)
        rows = map(json.loads, (tmp_path / name / "metrics.jsonl").read_text().splitlines())
        curves[name] = [(r["env_step"], r["eval/return"]) for r in rows if "eval/return" in r]
    until = min(curve[-1][0] for curve in curves.values())
    ends = {name: at(until, curve) for name, curve in curves.items()}
    words = seen(Store(tmp_path).runs())
    found = re.findall(r"(mle|tom) ([\d,.]+\d)", words)
    said = {name: float(number.replace(",", "")) for name, number in found}
    assert said == {
        "mle": round(float(ends[NAMES[0]]), 1),
        "tom": round(float(np.mean([ends[name] for name in NAMES[1:]])), 1),
    }
    assert f"step {until:,}" in words


def test_without_a_run_it_says_nothing(tmp_path: Path):
    assert seen(Store(tmp_path).runs()) == ""
