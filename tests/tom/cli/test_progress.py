"""What a training, or a fleet of them, says of itself as it goes."""

import io
import re

import numpy as np

from tom.cli import fleet_progress, progress, screen
from tom.cli.fleet_progress import FleetReport
from tom.cli.progress import ProgressReport
from tom.events import Episode, Evaluation, Notice, Tick
from tom.training.plan import Trial


def test_a_resumed_run_counts_its_own_steps_only(monkeypatch):
    seconds = iter(range(0, 1000, 10))
    monkeypatch.setattr(progress, "monotonic", lambda: float(next(seconds)))
    said = io.StringIO()
    with ProgressReport("hopper", 40_000, said) as report:
        for step in range(5_001, 5_101, 10):  # a step a second
            report.consume(Tick(step, "optimise"))
    found = re.findall(r"hopper (\d+)/40000 optimise (\d+) steps/s eta (\d+) s", said.getvalue())
    assert len(found) > 2
    assert {int(rate) for _, rate, _ in found} == {1}
    assert {int(step) + int(eta) for step, _, eta in found} == {40_000}


def test_the_first_step_says_no_rate():
    said = io.StringIO()
    with ProgressReport("hopper", 1, said) as report:
        report.consume(Tick(1, "optimise"))
    assert said.getvalue() == "hopper 1/1 optimise\n"


def fleet() -> list[Trial]:
    return [
        Trial("inverted-pendulum", learner, seed, "smoke", {"steps": 300})
        for learner in ("mle", "tom")
        for seed in (0, 1)
    ]


def evaluation(step: int, *returns: float) -> Evaluation:
    return Evaluation(step, [episode(value) for value in returns])


def episode(value: float) -> Episode:
    none = np.zeros((1, 1), np.float32)
    return Episode(np.array([value], np.float32), none, none)


def test_a_fleet_says_whose_notice_it_is_and_the_mean_of_each_learner(monkeypatch):
    seconds = iter(range(0, 1000, 30))
    monkeypatch.setattr(fleet_progress, "monotonic", lambda: float(next(seconds)))
    said, trials = io.StringIO(), fleet()
    with FleetReport(trials, said) as report:
        watchers = report.watchers()
        for watcher, value in zip(watchers, (10.0, 30.0, 5.0), strict=False):
            watcher(evaluation(250, value, value + 2))
        watchers[3](Notice(250, "runaway-dual", "Q falls"))
        watchers[1](Tick(251, "optimise"))
    lines = said.getvalue().splitlines()
    assert lines[0] == f"{trials[3].run_id} step 250: Q falls"
    assert lines[1] == "inverted-pendulum, 4 in a fleet 251/300 mean return: mle 21.0, tom 6.0"


def test_a_terminal_sees_every_member(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(screen.StoppableConsole, "is_terminal", True)
    said, trials = io.StringIO(), fleet()
    with FleetReport(trials, said) as report:
        watchers = report.watchers()
        watchers[0](evaluation(250, 10.0))
        watchers[0](evaluation(260, 4.0))
        for watcher in watchers:
            watcher(Tick(300, "evaluate"))
    shown = said.getvalue()
    (first,) = [line for line in shown.splitlines() if trials[0].run_id in line][-1:]
    assert [cell.strip() for cell in first.split("│")[1:-1]][1:] == [
        "evaluate", "300", "4.0", "10.0",
    ]  # fmt: skip
    assert all(trial.run_id in shown for trial in trials)
