"""Runs and weighings as frames: the numbers are those of the files."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from loops import loaded

import tom
from tom.cli import main
from tom.errors import UserError
from tom.frames import Run, Weighing
from tom.record import RunReader

GALLERY = Path(__file__).parents[2] / "runs"
RUN = "inverted-pendulum-tom-s0-162b7ad0"
QUICK = {"tom": {"q_steps": 20, "discriminator_steps": 20, "q_hidden": 16}}


@pytest.fixture(scope="module")
def run() -> Run:
    return loaded(GALLERY, RUN)


@pytest.fixture(scope="module")
def weighing() -> Weighing:
    return tom.weigh(
        RUN, RUN, seeds=[0, 3], footprint=100, learners=["pmac", "tom"], settings=QUICK,
        store=GALLERY,
    )  # fmt: skip


def weighed(path: Path) -> Weighing:
    """A stored weighing."""
    found = tom.load(path)
    assert isinstance(found, Weighing)
    return found


def test_a_run_is_what_its_folder_holds(run: Run):
    reader = RunReader(GALLERY / RUN)
    metrics = reader.metrics()
    assert str(run.summary["env"]) == "inverted-pendulum"
    assert run.metrics.index.tolist() == metrics["env_step"].tolist()
    last = metrics["eval/return"].dropna().tolist()[-1]
    assert run.metrics["eval/return"].dropna().tolist()[-1] == last
    assert run.summary.to_dict()["last_return"] == last
    np.testing.assert_array_equal(run.profiles, reader.profiles().bins)
    rows = reader.buffer()[0]
    assert len(run.transitions) == len(rows)
    np.testing.assert_array_equal(run.transitions["next_obs_2"], np.asarray(rows.next_obs)[:, 2])
    assert run.transitions["terminated"].dtype == bool
    step = reader.snapshot_steps()[0]
    np.testing.assert_array_equal(run.weights(step), reader.snapshot(step))
    with pytest.raises(UserError, match="kept no weights of step 7: it kept"):
        run.weights(7)


def test_the_rows_of_a_fit_stand_in_one_table(run: Run, tmp_path: Path, capsys):
    step = run.reader.snapshot_steps()[-1]
    rows, whole = run.rows(step), run.transitions
    count = len(run.weights(step))
    numbers = list(range(step - count, step))
    assert rows["row"].tolist() == numbers
    pd.testing.assert_frame_equal(
        rows.filter(list(whole.columns)), whole.iloc[numbers].reset_index(drop=True)
    )
    ended = whole["terminated"] | whole["truncated"]
    episode = ended.shift(fill_value=False).cumsum()
    assert rows["episode"].tolist() == episode[numbers].tolist()
    assert rows["episode_step"].tolist() == whole.groupby(episode).cumcount()[numbers].tolist()
    np.testing.assert_array_equal(rows["weight"], run.weights(step)["weight"])
    log = np.log2(np.maximum(rows["weight"] / rows["weight"].mean(), 1 / 32))
    assert abs(np.corrcoef(rows["contrast_0"], log)[0, 1]) >= max(
        abs(np.corrcoef(rows[name], log)[0, 1]) for name in ("contrast_1", "pc_0", "pc_1")
    )
    stored = np.load(GALLERY / RUN / "policies" / f"{step:09d}.npz")
    layer = rows.filter(regex="^obs_").to_numpy(np.float64)
    layers = sum(name.startswith("weight_") for name in stored)
    for k in range(layers):
        layer = layer @ stored[f"weight_{k}"].astype(float) + stored[f"bias_{k}"]
        layer = np.maximum(layer, 0) if k < layers - 1 else layer
    gap = np.tanh(layer[:, :1]) - rows[["action_0"]]
    assert rows["policy_distance"].to_numpy() == pytest.approx(np.abs(gap["action_0"]), abs=1e-4)
    command = ["runs", "export", RUN, "--store", str(GALLERY), "--out", str(tmp_path)]
    assert main([*command, "--rows"]) == 0
    (written,) = tmp_path.glob(f"{RUN}-rows-{step}.parquet")
    pd.testing.assert_frame_equal(pd.read_parquet(written), rows)
    assert main([*command, "--rows", "7"]) == 2
    assert main([*command, "--rows", str(step), "--small"]) == 2
    assert list(tmp_path.iterdir()) == [written]


def test_weights_of_others_for_the_same_rows_stand_beside(weighing: Weighing, tmp_path: Path):
    shutil.copytree(GALLERY / RUN, tmp_path / RUN)
    weighing.save(tmp_path / "weighings" / "of-more-rows")
    run = loaded(tmp_path, RUN)
    last = run.reader.snapshot_steps()[-1]
    same = tom.weigh(
        RUN, RUN, step=last, seeds=[2], footprint=100, learners=["pmac"], store=tmp_path
    )
    same.save(tmp_path / "weighings" / "of-these")
    rows = run.rows(last)
    assert [name for name in rows if "-s" in name] == ["pmac-s2"]
    np.testing.assert_array_equal(rows["pmac-s2"], same.weights["pmac-s2"])
    both = ["obs_0", "action_0", "policy_distance", "error", "pmac-s2"]
    pd.testing.assert_frame_equal(same.rows().loc[:, both], rows.loc[:, both])


def test_a_weighing_is_kept_as_tom_weigh_keeps_it(weighing: Weighing, tmp_path: Path):
    assert weighing.weights.columns.tolist() == ["pmac-s0", "tom-s0", "pmac-s3", "tom-s3"]
    assert weighing.weights.mean().tolist() == pytest.approx([1] * 4, abs=1e-4)
    assert weighing.table["learner"].tolist() == ["pmac", "tom", "pmac", "tom"]
    profiles = weighing.by_learner()
    assert {name: found.shape for name, found in profiles.items()} == {
        "pmac": (2, 100), "tom": (2, 100),
    }  # fmt: skip
    assert weighing.profiles["tom-s3"].tolist() == pytest.approx(profiles["tom"][1])
    out = weighing.save(tmp_path / "weighings" / "mine")
    again = weighed(out)
    pd.testing.assert_frame_equal(again.weights, weighing.weights)
    assert again.policy_distance == pytest.approx(weighing.policy_distance)
    assert again.table["ess"].tolist() == pytest.approx(weighing.table["ess"])
    results = [{**result, "footprint_se": None} for result in again.report["results"]]
    without = replace(again, report={**again.report, "results": results}).table["footprint_se"]
    assert np.isnan(without.to_numpy()).all()
    assert without.dtype == float
    with pytest.raises(UserError, match="exists already"):
        weighing.save(out)
    with pytest.raises(UserError, match="was loaded from a folder: copy that folder"):
        again.save(tmp_path / "copy")
    with pytest.raises(UserError, match="are not kept here: load its run"):
        _ = again.transitions  # its run is in another store


def test_the_rows_of_a_weighing_come_from_its_run(weighing: Weighing, run: Run):
    pd.testing.assert_frame_equal(weighing.transitions, run.transitions)
    stored = sorted((GALLERY / "weighings").glob("hopper-tom-*"))[0]
    found = weighed(stored)
    assert len(found.transitions) == len(found.weights) == found.report["rows"]
    assert found.random_share == found.report["ordered_from"] / found.report["rows"]


def test_a_weighing_numbers_its_rows_as_the_run_of_a_full_buffer_does(tmp_path: Path):
    folder = shutil.copytree(GALLERY / RUN, tmp_path / RUN)
    config = json.loads((folder / "config.json").read_text())
    config["config"]["replay_capacity"] = 200
    (folder / "config.json").write_text(json.dumps(config))
    rows = tom.weigh(
        RUN, RUN, step=300, seeds=[0], footprint=100, learners=["pmac"], store=tmp_path
    ).rows()
    assert rows["row"].tolist() == list(range(100, 300))
    episodes = loaded(GALLERY, RUN).rows(300)
    assert rows["episode"].tolist() == episodes["episode"][100:].tolist()


def test_the_rows_of_own_data_are_those_of_its_file_with_every_learners_weight(tmp_path: Path):
    rng = np.random.default_rng(0)
    file = {name: rng.normal(size=(90, 3)).astype(np.float32) for name in ("obs", "next_obs")}
    file |= {"action": rng.uniform(-2, 2, (90, 1)).astype(np.float32)}
    file |= {name: np.zeros(90, np.float32) for name in ("reward", "terminated", "truncated")}
    file["truncated"][[29, 89]] = 1
    np.savez(tmp_path / "own.npz", allow_pickle=False, **file)
    out = tmp_path / "weighings" / "own"
    of = ["weigh", str(tmp_path / "own.npz"), "--env", "gymnasium:Pendulum-v1"]
    by = ["--policy", "random", "--learner", "mle", "pmac", "--seeds", "4", "--footprint", "50"]
    assert main([*of, *by, "--store", str(tmp_path), "--out", str(out)]) == 0
    command = ["runs", "export", "own", "--store", str(tmp_path), "--out", str(tmp_path)]
    assert main([*command, "--rows", "90"]) == 2
    assert main([*command, "--rows"]) == 0
    rows = pd.read_parquet(tmp_path / "own-rows.parquet")
    made = weighed(out)
    pd.testing.assert_frame_equal(rows, made.rows())
    unit = file["next_obs"] / [1, 1, 8]  # agents see the task's bounds as -1 and 1
    np.testing.assert_allclose(rows.filter(regex="^next_obs_"), unit, rtol=1e-6)
    np.testing.assert_allclose(rows["action_0"], file["action"][:, 0] / 2, rtol=1e-6)
    assert rows["row"].tolist() == list(range(90))
    assert rows["episode_step"].tolist() == [*range(30), *range(60)]
    np.testing.assert_allclose(rows["policy_distance"], np.abs(rows["action_0"]), rtol=1e-6)
    np.testing.assert_array_equal(rows["pmac-s4"], made.weights["pmac-s4"])
    np.testing.assert_array_equal(rows["weight"], made.weights["mle-s4"])
    of_other = made.rows("pmac-s4")
    np.testing.assert_array_equal(of_other["weight"], made.weights["pmac-s4"])
    assert not np.array_equal(of_other["contrast_0"], rows["contrast_0"])
    with pytest.raises(UserError, match="pmac-s4"):
        made.rows("pmac-s5")


def test_what_is_neither_a_run_nor_a_weighing(tmp_path: Path):
    with pytest.raises(UserError, match="no run or weighing 'nothing'"):
        tom.load("nothing", store=tmp_path)
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(UserError, match="cannot be read"):
        tom.load(tmp_path)
    for wrong in ({"learners": ["tmo"]}, {"footprint": 0}):
        with pytest.raises(UserError):
            tom.weigh(RUN, RUN, store=GALLERY, **wrong)
