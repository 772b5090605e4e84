"""What a training says of itself as it goes."""

import io
import re

from tom.cli import progress
from tom.cli.progress import ProgressReport
from tom.events import Tick


def test_a_resumed_run_counts_only_its_own_steps(monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress, "monotonic", lambda: now)
    shown = io.StringIO()
    with ProgressReport("hopper", 40_000, shown) as report:
        for step in range(5_001, 5_101):
            now += 1.0
            report.consume(Tick(step, "optimise"))
    found = re.findall(r"hopper (\d+)/40000 optimise (\d+) steps/s eta (.+)", shown.getvalue())
    assert len(found) > 2
    assert {int(rate) for _, rate, _ in found} == {1}
    assert all(eta.startswith("9 h 4") for _, _, eta in found)


def test_the_first_step_says_no_rate():
    shown = io.StringIO()
    with ProgressReport("hopper", 1, shown) as report:
        report.consume(Tick(1, "optimise"))
    assert shown.getvalue() == "hopper 1/1 optimise\n"
