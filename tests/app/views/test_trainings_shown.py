"""Trainings on the first page: the strip of those that run, their cards, the form that starts."""

import json
import os
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import TIMEOUT_S, Show, draw, recorded
from studio_runs import (
    PENDULUM_TOM,
    ROAD_MLE,
    info,
    set_status,
    stand_in,
    trains_elsewhere,
)

from app.data import trainings
from app.data.trainings import Started
from app.parts import jobs, start
from app.parts.start import main_numbers
from tom.record import layout
from tom.record.lock import acquire

pytestmark = pytest.mark.usefixtures("studio")
SECOND = "pendulum-tom-1"


def shown(app: AppTest) -> list[str]:
    """The runs of the cards, in their order, whose heads have the ids as titles."""
    heads = [block.proto.body for block in app.get("html") if "title=" in block.proto.body]
    return [body.split('title="')[1].split('"')[0] for body in heads]


def test_the_strip_has_what_trains_and_for_a_while_what_has_ended(own: Path) -> None:
    for run in own.iterdir():
        if (run / layout.STATUS).exists():
            set_status(run, heartbeat=time.time() - start.RECENT_S - 1)
    assert shown(draw("answer")) == []
    set_status(own / PENDULUM_TOM, heartbeat=time.time())
    set_status(own / ROAD_MLE, state="running", heartbeat=time.time() - 1000)
    trains_elsewhere(own / SECOND)
    app = draw("answer")
    assert shown(app) == [SECOND, PENDULUM_TOM]
    values = {metric.label: metric.value for metric in app.metric}  # those of the last card
    assert values["last return"] == f"{recorded(own, PENDULUM_TOM)[1][-1]:,.1f}"


def test_a_training_that_was_asked_to_stop_is_not_asked_again(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trains_elsewhere(own / SECOND)
    asked: list[str] = []
    monkeypatch.setattr(trainings, "stop", lambda _, run_id: asked.append(run_id))
    app = draw("answer")
    app.session_state["asked to stop"] = set()
    app.button(key=f"stop {SECOND} now").click().run()
    app.run()
    assert asked == [SECOND]
    assert not [button for button in app.button if (button.key or "").startswith("stop ")]


def test_a_run_that_only_explores_has_no_speed(own: Path) -> None:
    folder = own / PENDULUM_TOM
    (folder / layout.METRICS_TABLE).unlink()
    rows = [{"env_step": step, "time/checkpoint_s": 0.1} for step in (1, 2)]
    (folder / layout.METRICS).write_text("".join(json.dumps(row) + "\n" for row in rows))
    trains_elsewhere(folder)
    set_status(folder, env_steps_per_s=0.0)
    numbers = dict(main_numbers(info(own, PENDULUM_TOM)))
    assert numbers["steps / s"] == "-"  # a fit takes no step: that is no speed of 0
    assert numbers["memory"] == "-"  # of a process that is not here
    assert not draw("curves", task="inverted-pendulum", find=PENDULUM_TOM).exception


def test_a_training_of_this_machine_has_a_size_and_one_of_this_studio_a_log(own: Path) -> None:
    with closing(acquire(own / SECOND)):
        alive = {"state": "running", "heartbeat": time.time(), "pid": os.getpid()}
        set_status(own / SECOND, **alive)
        assert dict(main_numbers(info(own, SECOND)))["memory"].endswith("B")
    begun = stand_in(["train"], "print('first'); print('last')")
    begun.process.wait(TIMEOUT_S)
    jobs.started_commands()["a training"] = begun
    set_status(own / PENDULUM_TOM, pid=begun.process.pid)
    assert start.log_of(info(own, PENDULUM_TOM)) == "first\nlast"
    assert start.log_of(info(own, ROAD_MLE)) == ""


def test_a_training_that_fails_before_it_has_a_run_says_why() -> None:
    begun = stand_in(["train"], "raise SystemExit('no such thing')")
    begun.process.wait(TIMEOUT_S)
    jobs.started_commands()["tom train"] = begun
    assert "no such thing" in [code.value for code in draw("answer").code]


@pytest.mark.parametrize(
    ("key", "job", "query"),
    [
        ("weigh", f"Weighing {PENDULUM_TOM}", {"part": "Every learner on one buffer"}),
        ("brush it", f"Brush of {PENDULUM_TOM}", {"where": "age 80.."}),
    ],
)
def test_what_goes_on_is_not_started_again(key: str, job: str, query: dict[str, str]) -> None:
    def is_offered() -> bool:
        return not draw("attention", run=PENDULUM_TOM, **query).button(key=key).disabled

    assert is_offered()
    begun = stand_in(["weigh"], "import time; time.sleep(600)")
    jobs.started_commands()[job] = begun
    assert not is_offered()
    begun.process.kill()
    begun.process.wait(TIMEOUT_S)
    assert is_offered()


# The form


def form() -> AppTest:
    """The page after the form was opened."""
    app = draw("answer")
    assert not [field for field in app.text_input if (field.key or "").startswith("start")]
    app.session_state[start.FOLD] = True  # as a click on its title does
    return app.run()


def test_the_form_writes_the_command(store: Path) -> None:
    app = form()
    app.selectbox(key="start env").select("hopper").run()
    app.session_state[start.FOLD] = False
    app.multiselect(key="start seeds").select(1).run()
    app.text_input(key="start set sac.lr").input("0.001").run()
    assert "2" in app.button(key="start").label
    shown = next(code.value for code in app.code if "tom train" in code.value)
    assert shown.startswith("tom train --env hopper --learner tom --preset mended --seed 0")
    assert shown.endswith(f"--sac.lr=0.001 --store {store}")
    app.text_input(key="start set sac.discount").input("2").run()
    assert "discount" in app.error[0].value
    assert not [button for button in app.button if button.key == "start"]


def test_a_second_click_starts_no_second_training(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = list[str]()

    def begin(arguments: Sequence[str]) -> Started:
        begun.append(" ".join(arguments))
        return stand_in(arguments, "import time; time.sleep(600)")

    monkeypatch.setattr(trainings, "start", begin)
    app = form()
    app.button(key="start").click().run()
    app.button(key="start").click().run()
    app.multiselect(key="start seeds").select(1).run()
    app.button(key="start").click().run()
    assert ["--seed 0" in begun[0], "--seed 1" in begun[1], len(begun)] == [True, True, 2]
    for one in jobs.started_commands().values():
        one.process.kill()


def test_the_preset_is_the_learners_own_until_another_is_chosen() -> None:
    app = form()
    app.selectbox(key="start env").select("hopper").run()
    preset, learner = "start preset", "start learner"
    assert app.selectbox(key=preset).value == "mended"
    assert app.selectbox(key=learner).select("mle").run().selectbox(key=preset).value == "paper"
    app.selectbox(key=preset).select("smoke").run()
    assert app.selectbox(key=learner).select("tom").run().selectbox(key=preset).value == "smoke"
    assert not app.warning
    assert not app.exception


@pytest.mark.parametrize(("host", "key"), [("0.0.0.0", "key"), ("::1", ""), ("::1", "another")])
def test_nothing_is_started_for_others_or_without_the_key(
    host: str, key: str, store: Path, show: Show
) -> None:
    show(store, host=host, key=key)
    app = draw("answer")
    app.session_state[start.FOLD] = True
    app.run()
    assert not [one for one in app.button if (one.key or "").startswith(("start", "stop"))]
