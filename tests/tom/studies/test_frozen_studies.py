"""Every way of weighing on the same frozen buffers: footprint and capacity."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tom.config import SacRecordingConfig
from tom.data.transitions import BEHAVIOUR
from tom.errors import UserError
from tom.record import RunReader, Store
from tom.studies import capacity, footprint, frozen
from tom.studies.footprint import footprint_figure
from tom.studies.frozen import (
    Case,
    buffer_at,
    cases,
    examine,
    moments,
)
from tom.studies.moments import sign_test
from tom.studies.study import Row
from tom.training.run import train

BASE: Row = {
    "recording": "a",
    "env": "hopper",
    "step": 100,
    "way": "uniform",
    "seed": 0,
    "ess": 1.0,
    "ends": 0.02,
    "ends_policy": 0.01,
    "footprint": 1.0,
    "footprint_uniform": 0.4,
    "footprint_noise": 0.1,
}


def test_moments_are_fits_on_policy_whose_policy_was_kept(run: RunReader):
    steps = moments(run, 100)
    assert min(steps) >= 1200
    assert set(steps) <= set(run.policy_steps())
    assert moments(run, 2) == [steps[0], steps[-1]]


def test_what_a_way_makes_of_a_moment(run: RunReader):
    at = moments(run, 1)[0]
    uniform = examine(Case(run.path, at, "uniform", models=("linear",), rows=300))
    assert uniform["footprint"] == pytest.approx(1.0)
    assert uniform["ess"] == pytest.approx(1.0)
    newest = examine(Case(run.path, at, "newest", models=("linear",), rows=300))
    assert newest["ess"] == pytest.approx(1000 / at)
    assert newest["footprint"] != pytest.approx(1.0)
    assert newest["footprint_uniform"] == uniform["footprint_uniform"]
    for one in (uniform, newest):
        assert 0 < one["error linear"] < 10
    assert uniform["rollout error linear"] != newest["rollout error linear"]


def test_a_run_without_its_policies_is_left_out_of_the_ways_that_need_them(
    run: RunReader, tmp_path: Path
):
    old = RunReader(shutil.copytree(run.path, tmp_path / "old"))
    for path in (old.path / "buffer").iterdir():
        with np.load(path) as held:
            kept = {name: held[name] for name in held.files if name not in BEHAVIOUR}
        np.savez(path, allow_pickle=False, **kept)
    ways = ("uniform", "policy-distance", "recency", "half-pdml")
    both = [(one.run.name, one.way) for one in cases([run, old], ways, [0], 1)]
    assert both == [(run.run_id, way) for way in ways] + [("old", "uniform"), ("old", "recency")]
    with pytest.raises(UserError):
        cases([old], ("uniform", "policy-distance"), [0], 1)


def test_ways_share_random_numbers_and_moments_do_not():
    seeds = [
        [Case(Path("store") / name, step, way, seed).stream_seed for way in ("uniform", "ratio")]
        for name, step, seed in [("a", 100, 0), ("b", 100, 0), ("a", 200, 0), ("a", 100, 1)]
    ]
    assert all(first == second for first, second in seeds)
    assert len({first for first, _ in seeds}) == 4


def test_the_outcome_of_a_way_does_not_depend_on_what_was_examined_before(run: RunReader):
    at, then = moments(run, 2)
    case = Case(run.path, at, "recency", models=("linear",), rows=300)
    first = examine(case)
    again = examine(replace(case, way="newest")), examine(case)  # as the moment's second way
    assert again[0]["footprint"] != first["footprint"]
    assert again[1] == first
    other = examine(replace(case, step=then))
    assert (other["step"], other["ends_policy"]) != (first["step"], first["ends_policy"])
    assert other["footprint_uniform"] != first["footprint_uniform"]
    assert examine(replace(case, rows=400))["footprint_uniform"] != first["footprint_uniform"]
    assert examine(case) == first


def test_a_footprints_summary_by_hand():
    found = [
        BASE,
        dict(BASE, way="ratio", footprint=0.5, ess=0.2),
        dict(BASE, way="ratio", step=200, footprint=0.7, ends=0.04),
        dict(BASE, way="ratio", recording="b", footprint=1.2),
        dict(BASE, way="ratio", recording="c", env="walker2d", footprint=2.0),
        dict(BASE, way="ratio", recording="d", env="walker2d", footprint=np.nan),
    ]
    uniform, ratio = footprint.summary(found)
    assert uniform["distance"] == 1
    # Hopper: medians .6 and 1.2 of its two runs, .9 on average; Walker: 2.
    assert ratio["distance"] == pytest.approx((0.9 + 2.0) / 2)
    assert ratio["hopper"] == 0.7
    assert ratio["below uniform"] == 0.5
    assert ratio["n"] == 4
    assert ratio["ends over policy's"] == pytest.approx(0.10 / 0.04)


def test_a_way_without_a_moment_in_a_task_has_a_dash_there():
    shared = dict.fromkeys(("ess", "ends", "ends_policy", "footprint_noise", "footprint"), 0.5)
    found = [
        {"way": way, "env": env, "recording": f"of {env}", "step": 1, "seed": 0, **shared}
        for env, way in (("hopper", "uniform"), ("walker2d", "uniform"), ("walker2d", "pdml"))
    ]
    uniform, pdml = footprint.summary(found)
    assert [*uniform] == [*pdml]  # or the table's columns would not be its titles'
    assert (np.isnan(pdml["hopper"]), pdml["walker2d"]) == (True, 0.5)


def drowned() -> list[Row]:
    """Recording a tells .3 for recency; b's distances (4) are lost in noise."""
    return [
        dict(BASE, way=way, recording=recording, footprint=distance, footprint_noise=noise)
        for recording, noise, distances in (("a", 0.1, (1.0, 0.3)), ("b", 7.0, (1.0, 4.0)))
        for way, distance in zip(("uniform", "recency"), distances, strict=True)
    ]


def test_moments_whose_noise_drowns_the_distances_do_not_count_and_are_named():
    _, recency = footprint.summary(drowned())
    assert (recency["distance"], recency["n"]) == (0.3, 1)
    said = footprint.in_sentences(drowned())
    (line,) = (line for line in said if "Not counted" in line)
    assert line.endswith("b at 100.")
    assert not any("Not counted" in line for line in footprint.in_sentences(drowned()[:2]))
    (panel,) = footprint_figure(drowned()).axes
    assert np.asarray(panel.collections[0].get_offsets())[:, 0].tolist() == [0.3]


def errors_of(model: str, error: float) -> Row:
    return {f"error {model}": error, f"rollout error {model}": 2 * error}


def test_a_capacitys_summary_by_hand():
    def errors(linear: float, small: float) -> Row:
        return errors_of("linear", linear) | errors_of("8 x 2", small)

    found = [
        dict(BASE, **errors(1.0, 0.5)),
        dict(BASE, step=200, **errors(2.0, 0.5)),
        dict(BASE, way="ratio", **errors(0.5, 0.6)),
        dict(BASE, way="ratio", step=200, **errors(1.5, 0.6)),
    ]
    linear, small = capacity.summary(found)
    assert (linear["model"], small["model"]) == ("linear", "8 x 2")
    assert linear["one step"] == pytest.approx((0.5 + 0.75) / 2)
    assert linear["five steps"] == linear["one step"]
    assert linear["one step, below 1"] == 1
    assert small["one step"] == pytest.approx(1.2)
    assert small["one step, below 1"] == 0
    # A second seed of the same two moments makes trials, not moments.
    twice = [*found, *(dict(one, seed=1) for one in found)]
    assert "in 100% of 4 trials" in capacity.in_sentences(capacity.summary(twice), [])[0]


def test_two_ways_are_compared_moment_by_moment():
    def moment(recording: str, env: str, step: int, mended: float, ratio: float) -> list[Row]:
        at = dict(BASE, recording=recording, env=env, step=step)
        return [
            dict(at, way="tom-mended", footprint=mended),
            dict(at, way="ratio", footprint=ratio),
        ]

    outcomes = [
        dict(BASE, recording="a", step=1),
        *moment("a", "hopper", 1, 0.5, 0.6),
        *moment("a", "hopper", 2, 0.2, 0.5),  # a's median difference: -.2
        *moment("b", "hopper", 1, 0.9, 0.5),
        *moment("c", "walker2d", 1, 0.1, 0.3),
        *moment("d", "walker2d", 1, 0.3, 0.9),
        *moment("d", "walker2d", 2, np.nan, 0.1),
        dict(BASE, way="tom-mended", recording="alone"),
        dict(BASE, way="recency", recording="elsewhere"),
    ]
    (row,) = footprint.head_to_head(outcomes)  # no moment was weighed by recency and by TOM
    assert (row["way"], row["against"]) == ("tom-mended", "ratio")
    assert (row["nearer at"], row["n"]) == (4, 5)
    assert row["difference"] == pytest.approx(((-0.2 + 0.4) / 2 + (-0.2 - 0.6) / 2) / 2)
    assert row["low"] == pytest.approx((-0.2 - 0.6) / 2)  # b and c are not drawn
    assert row["high"] == pytest.approx((0.4 - 0.2) / 2)
    assert row["hopper"] == pytest.approx((-0.2 + 0.4) / 2)
    assert row["walker2d"] == pytest.approx((-0.2 - 0.6) / 2)
    outcomes.append(dict(BASE, way="recency", env="ant", recording="e"))
    assert np.isnan(footprint.head_to_head(outcomes)[0]["ant"])  # all rows have the same columns
    # Nearer in most moments on a, c and d, further on b: as uneven by chance 10 times in 16.
    assert (row["better on"], row["recordings"], row["p"]) == (3, 4, 0.625)


def test_a_sign_test_counts_recordings_by_hand():
    differences = [
        ("hopper", "a", 3.0),
        ("hopper", "a", 1.0),
        ("hopper", "a", -90.0),  # most of a's moments are above
        ("hopper", "b", 1.0),
        ("hopper", "b", -1.0),  # as many above as below
        *((env, "c", 1.0) for env in ("hopper", "walker2d", "ant", "humanoid")),
        ("halfcheetah", "c", 0.0),
    ]
    signs = sign_test(differences)
    assert (signs.above, signs.n) == (5, 5)
    assert signs.p == pytest.approx(2 / 2**5)
    assert sign_test([]).p == 1


def test_two_ways_are_compared_for_every_model():
    def error(way: str, recording: str, linear: float, small: float) -> Row:
        errors = errors_of("linear", linear) | errors_of("8 x 2", small)
        return dict(BASE, way=way, recording=recording, **errors)

    outcomes = [
        error("uniform", "a", 1.0, 1.0),
        error("half-tom-mended", "a", 1.0, 3.0),
        error("half-recency", "a", 2.0, 2.0),
        error("half-tom-mended", "b", 2.0, 2.0),
        error("half-recency", "b", 1.0, 1.0),
    ]
    rows = capacity.head_to_head(outcomes)
    alone = [row["n"] for row in rows if row["against"] == "uniform"]
    assert alone == [1] * 4  # two ways, two models; uniform weights are known for recording a
    linear, small = (row for row in rows if row["against"] == "half-recency")
    assert (linear["model"], small["model"]) == ("linear", "8 x 2")
    assert linear["ratio"] == pytest.approx(1.0)  # a half and twice
    assert (linear["low"], linear["high"]) == pytest.approx((0.5, 2.0))
    assert (linear["less at"], linear["n"]) == (1, 2)
    assert small["ratio"] == small["hopper"] == pytest.approx(np.sqrt(3.0))
    assert (small["better on"], small["recordings"], small["p"]) == (0, 2, 0.5)


@pytest.mark.slow
def test_a_recording_of_sac_stands_for_a_replay_buffer(tmp_path: Path):
    config = SacRecordingConfig(env="hopper").but(
        steps=1500,
        exploration_steps=200,
        snapshots=5,
        sac={"hidden": 16, "batch_size": 32},
        evaluation={"every": 1500, "episodes": 1},
    )
    recording = train(config, Store(tmp_path), "recorded", rerun=False)
    assert recording.policy_steps() == [1800, 2100, 2400, 2700, 3000]
    assert moments(recording, 10) == [2700, 3000]  # a policy buffer of on-policy rows before each
    newest = examine(Case(recording.path, 2700, "newest", rows=300))
    assert newest["ess"] == pytest.approx(1000 / 2700)


def test_a_buffer_cut_within_an_episode_starts_none_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(frozen, "RANDOM", 5)
    config = SacRecordingConfig(env="hopper").but(
        steps=60, exploration_steps=50, snapshots=2, sac={"hidden": 16, "batch_size": 32}
    )
    recording = train(config, Store(tmp_path), "recorded", rerun=False)
    rows, _ = recording.buffer()
    ended = rows.ended()
    assert not ended[54]  # or the row that the cut leaves first would be a start
    data = buffer_at(recording, 110)
    assert len(data) == 55
    assert torch.equal(data.transitions.obs, torch.as_tensor(rows.obs[55:110]))
    starts = np.flatnonzero(np.append(True, ended[:109]))
    assert torch.equal(data.initial_obs, torch.as_tensor(rows.obs[starts]))
