"""Data that no run collected, in a store that holds nothing else: Attention shows it."""

import shlex
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import QUICK
from studio_pages import Show, draw, figures, in_buffer, on_one_buffer
from studio_runs import PENDULUM_TOM

from app.data import buffer_map, weighings, why
from app.router import VIEWS, View
from tom.cli import main
from tom.envs import task
from tom.policy.collect import footprint
from tom.policy.stored import UniformPolicy
from tom.record.files import read_json
from tom.record.reader import RunReader

ENV = "inverted-pendulum"
N = 300
GALLERY_RUN = str(Path(__file__).parents[3] / "runs" / "inverted-pendulum-tom-s0-162b7ad0")


@pytest.fixture(scope="module")
def weighed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with two weighings of one file, and one of another."""
    folder = tmp_path_factory.mktemp("own")
    for seed, name in enumerate(("my buffer", "other")):
        generator = torch.Generator().manual_seed(seed)
        rows = footprint(task(ENV), UniformPolicy(4, 1), N, seed, generator).transitions
        columns = {field.name: np.asarray(getattr(rows, field.name)) for field in fields(rows)}
        columns["action"] = 3 * columns["action"]  # in the task's own units
        np.savez(folder / f"{name}.npz", allow_pickle=False, **columns)
    words = ["--policy", "random", "--env", ENV, "--footprint", "50", "--learner", "pmac", "mle"]
    words += ["--pmac.decay", "0.99"]
    for name, out in (("other", "third"), ("my buffer", "first"), ("my buffer", "second")):
        made = ["--out", str(folder / "store/weighings" / out), "--store", str(folder / "store")]
        assert main(["weigh", str(folder / f"{name}.npz"), *words, *made]) == 0
    return folder / "store"


@pytest.fixture(autouse=True)
def studio(weighed: Path, show: Show) -> None:
    show(weighed)


def named(weighed: Path, start: str) -> str:
    return next(i.run_id for i in weighings.datasets(str(weighed)) if i.run_id.startswith(start))


def test_rows_that_were_weighed_twice_are_one_data_set(weighed: Path):
    found = weighings.datasets(str(weighed))
    assert [one.run_id.rpartition("-")[0] for one in found] == ["my buffer", "other"]
    assert [Path(one.path).name for one in found] == ["second", "third"]
    assert RunReader(found[0].home).buffer_length() == N  # as the 3D scene reads it
    assert {one.name for one in weighings.of_run(found[0])} == {"first", "second"}


def test_each_learners_weights_of_the_data_are_shown(weighed: Path):
    app = on_one_buffer(run=named(weighed, "my buffer"), weighed="first")
    assert app.selectbox(key="data").options[1:] == [
        named(weighed, name) for name in ("my buffer", "other")
    ]
    assert not app.warning
    names = [line.get("name") for line in figures(app)[0]["data"]]
    assert "PMAC (3 seeds)" in names
    assert any(code.value.split()[0] == "tom" for code in app.code)
    assert "weigh" not in [button.key for button in app.button]


def test_a_run_that_is_chosen_in_the_list_takes_the_place_of_a_data_set(
    weighed: Path, store: Path, tmp_path: Path, show: Show
):
    both = shutil.copytree(weighed, tmp_path / "both")
    shutil.copytree(store / PENDULUM_TOM, both / PENDULUM_TOM)
    show(both)
    data = named(weighed, "other")
    app = on_one_buffer(data=data)
    for _ in range(2):
        assert app.selectbox(key="data").value == app.query_params["data"] == data
        app.run()
    app.session_state["run"] = [PENDULUM_TOM]  # as a click on its name does
    app.run()
    assert app.selectbox(key="data").value == "the chosen run"
    assert "data" not in app.query_params


def test_the_command_on_the_page_weighs_the_same_rows_again(
    weighed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    app = on_one_buffer(run=named(weighed, "my buffer"))
    words = shlex.split(next(code.value for code in app.code if "/weighings/" in code.value))
    monkeypatch.chdir(tmp_path)  # where no file of the user's lies
    assert main([*words[1:], "--out", "again"]) == 0
    found = weighings.of_run(weighings.datasets(str(weighed))[0])
    (before,) = (one.path for one in found if one.name == "first")
    old, new = read_json(before / "report.json"), read_json(tmp_path / "again" / "report.json")
    same = ("data", "rows_digest", "env", "policy", "preset", "rows", "footprint", "changed")
    assert [new[name] for name in same] == [old[name] for name in same]
    assert new["medians"] == old["medians"]


ACTING = """
import pathlib
def act(obs):
    pathlib.Path("asked").touch()
    return obs[:, :1]
"""


@pytest.mark.parametrize(("policy", "rows"), [("acting:act", 0), ("its", 100)])
def test_the_sum_of_a_weight_is_shown_and_no_code_of_the_users_runs(
    policy: str, rows: int, weighed: Path, tmp_path: Path, monkeypatch, show: Show
):
    monkeypatch.chdir(tmp_path)
    Path("acting.py").write_text(ACTING)
    shutil.copytree(GALLERY_RUN, "store/its")
    words = ["--policy", policy, "--env", ENV, "--learner", "tom", "--seeds", "0", *QUICK]
    assert main(["weigh", str(weighed.parent / "other.npz"), *words, "--store", "store"]) == 0
    Path("asked").unlink(missing_ok=True)
    (run,) = weighings.datasets("store")
    (source,) = buffer_map.sources(run).values()
    found = why.why_of(run, source)
    assert isinstance(found, why.Why)
    assert found.sum_of(7).weight == pytest.approx(source.weight[7], abs=1e-5)
    assert len(found.policy_rows) == rows
    show(tmp_path / "store")
    app = in_buffer(run=run.run_id, row="7")
    assert len(app.dataframe) == (2 if rows else 1)  # with the nearest of the policy's rows
    assert not Path("asked").exists()


def test_only_a_run_of_a_model_is_offered_to_be_brushed(tmp_path: Path, weighed: Path, show: Show):
    shutil.copytree(weighed, tmp_path / "store")
    shutil.copytree(GALLERY_RUN, tmp_path / "store/its")
    show(tmp_path / "store")
    for run, offered in (("its", True), (named(weighed, "other"), False)):
        app = in_buffer(run=run)
        assert ("factors" in [one.key for one in app.get("button_group")]) == offered


def test_weights_that_cannot_be_read_are_said(weighed: Path, tmp_path: Path, show: Show):
    shutil.copytree(weighed, tmp_path / "store")
    for path in (tmp_path / "store").rglob("weights.parquet"):
        path.write_bytes(b"no parquet")
    show(tmp_path / "store")
    assert "cannot be read" in in_buffer().warning[0].value
    assert "cannot be read" in on_one_buffer().warning[0].value


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_pages_do_without_any_run(view: View):
    draw(view.name)
