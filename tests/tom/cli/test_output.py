"""Tables and progress on standard output."""

import io
import re

import numpy as np
import pytest

from tom.cli import output
from tom.cli.output import ProgressReport, show
from tom.events import Episode, Evaluation, Tick


def test_in_a_pipe_a_row_is_one_line(capsys: pytest.CaptureFixture[str]):
    show("Title", ("name", "value"), [("half-tom-mended", "0.5"), ("x" * 300, "12")])
    title, *table = capsys.readouterr().out.splitlines()
    assert title == "Title"
    assert len(table) == 1 + 2 + 2 + 1  # head with its rule, two rows, in blank lines
    assert "| half-tom-mended" in table[3]
    assert table[3].endswith("   0.5 |")
    assert "x" * 300 in table[4]


def test_a_resumed_run_counts_only_its_own_steps(monkeypatch: pytest.MonkeyPatch):
    now = 0.0
    monkeypatch.setattr(output, "monotonic", lambda: now)
    shown = io.StringIO()
    with ProgressReport("hopper", 40_000, shown) as report:
        for step in range(5_001, 5_101):
            now += 1.0
            report.consume(Tick(step, "optimise"))
    found = re.findall(r"hopper (\d+)/40000 optimise (\d+) steps/s eta (.+)", shown.getvalue())
    assert len(found) > 2
    assert {int(rate) for _, rate, _ in found} == {1}
    assert all(eta.startswith("9 h 4") for _, _, eta in found)


def test_a_resumed_run_goes_on_from_its_returns():
    shown = io.StringIO()
    column = np.ones((4, 1), np.float32)
    played = Episode(reward=column[:3, 0], action=column[:3], obs=column)
    with ProgressReport("hopper", 1, shown, returns=[13.0, 9.5]) as report:
        report.consume(Tick(1, "optimise"))
        report.consume(Evaluation(1, [played]))
        report.consume(Tick(1, "optimise"))
    first, second = shown.getvalue().splitlines()
    assert re.findall(r"[\d.]+$|return [\d.]+", first) == ["return 9.5", "13.0"]
    assert re.findall(r"[\d.]+$|return [\d.]+", second) == ["return 3.0", "13.0"]
