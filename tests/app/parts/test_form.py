"""The form is the configuration: every setting, its default, and its own complaints."""

from pathlib import Path

import pytest
from studio_pages import Show
from studio_runs import PENDULUM_TOM, info

from app.parts import form, start
from tom import plugins
from tom.cli.parser import leaf_fields
from tom.config import OnlineConfig
from tom.errors import UserError


def test_every_setting_that_matters_is_a_field() -> None:
    fields = form.sections("hopper", "tom", "paper")
    paths = {setting.path for settings in fields.values() for setting in settings}
    others = {"pmac.decay", "vagram.clip_quantile"}
    assert paths == {path for path, _ in leaf_fields(OnlineConfig)} - form.LEFT_OUT - others
    assert "pmac" in form.sections("hopper", "pmac", "paper")


def test_defaults_are_the_presets() -> None:
    smoke = {s.path: s for s in form.sections("hopper", "tom", "smoke")["model"]}
    assert smoke["model.hidden"].default == "32"
    assert smoke["model.kind"].choices == ("mdn", "ensemble", "mean-ensemble", "linear")
    assert "mixture" in smoke["model.kind"].help
    road = {s.path: s for s in form.sections("road-and-rocks", "tom", "paper")["run"]}
    assert road["map_seed"].default == "none"
    assert road["expert_first"].choices == ("true", "false")


def test_a_training_that_only_explores_is_refused() -> None:
    with pytest.raises(UserError, match="all exploration"):
        form.train_arguments("hopper", "tom", "paper", 0, {"steps": "12"}, "runs")
    few = {"steps": "12", "exploration_steps": "10"}
    assert "--steps=12" in form.train_arguments("hopper", "tom", "paper", 0, few, "runs")
    assert form.train_arguments("road-and-rocks", "tom", "paper", 0, {"steps": "12"}, "runs")


def test_the_command_to_go_on_names_the_store_and_the_plugins(
    store: Path, show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    show(Path("my runs"))
    words = f"tom train --resume {PENDULUM_TOM} --store 'my runs'"
    assert start.resume_command(info(store, PENDULUM_TOM)) == words
    monkeypatch.setenv(plugins.VARIABLE, '["mine.py"]')
    assert start.resume_command(info(store, PENDULUM_TOM)) == f"{words} --plugin mine.py"
