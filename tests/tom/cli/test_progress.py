"""What a training says of itself as it goes."""

import io
import re

from tom.cli import progress
from tom.cli.progress import ProgressReport
from tom.events import Tick
from tom.readable import duration


def test_a_resumed_run_counts_its_own_steps_only(monkeypatch):
    seconds = iter(range(0, 1000, 10))
    monkeypatch.setattr(progress, "monotonic", lambda: float(next(seconds)))
    said = io.StringIO()
    with ProgressReport("hopper", 40_000, said) as report:
        for step in range(5_001, 5_101, 10):  # a step a second
            report.consume(Tick(step, "optimise"))
    found = re.findall(r"hopper (\d+)/40000 optimise (\d+) steps/s eta (.+)", said.getvalue())
    assert len(found) > 2
    assert {int(rate) for _, rate, _ in found} == {1}
    assert all(eta == duration(40_000 - int(step)) for step, _, eta in found)


def test_the_first_step_says_no_rate():
    said = io.StringIO()
    with ProgressReport("hopper", 1, said) as report:
        report.consume(Tick(1, "optimise"))
    assert said.getvalue() == "hopper 1/1 optimise\n"
