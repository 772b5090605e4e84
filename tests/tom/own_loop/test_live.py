"""`tom.weigh_live`: the weights of a growing buffer, computed beside the loop."""

from pathlib import Path

import numpy as np
import pytest
from kernel import wait_for
from loops import loaded

import tom
from tom.data.unpack import read_arrays
from tom.errors import UserError
from tom.frames import Weighing
from tom.own_loop.live import _LearnerRecord, follow, weigh_live
from tom.own_loop.run import OwnRun, record
from tom.record import RunReader, layout, lock
from tom.record.integrity import verify

PATIENCE_S = 120


def act(obs: np.ndarray) -> np.ndarray:
    return 2 * np.tanh(obs[:, 1:2])


def hand_in(run: OwnRun, rows: int, envs: int = 1) -> None:
    """Rows of a policy that moves: whatever it is asked to learn is in them."""
    rng = np.random.default_rng(run.step)
    for _ in range(rows // envs):
        lead = (envs,) if envs > 1 else ()
        obs, action = rng.normal(run.step / 500, 1, (*lead, 3)), rng.uniform(-2, 2, (*lead, 1))
        reward, no = rng.normal(size=lead), np.zeros(lead, bool)
        ended = no | (run.step // envs % 10 == 9)
        run.transitions(obs, action, reward, obs + 0.1, no, ended)
    run.policy(run.step, act)


def until_weighed(store: Path, learner: str, step: int) -> None:
    live = RunReader(store / "mine" / layout.LIVE / learner)
    wait_for(lambda: max(live.snapshot_steps(), default=0) >= step, PATIENCE_S)


@pytest.mark.parametrize("envs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_newest_buffer_is_weighed_beside_the_loop(envs: int, tmp_path: Path):
    with record("mine", env="Pendulum-v1", store=tmp_path, envs=envs) as run:
        assert run.latest_weights("pmac").tolist() == []
        hand_in(run, 400, envs)
        live = weigh_live(run, ("pmac", "tom"), every=400)
        until_weighed(tmp_path, "tom", 400)
        hand_in(run, 100, envs)
        weights = run.latest_weights("pmac")
        assert weights[400:].tolist() == [1.0] * 100
        hand_in(run, 700, envs)
    live.wait(PATIENCE_S)
    own, rows = loaded(tmp_path), {}
    assert [*own.live] == ["pmac", "tom"]
    assert not verify(own.reader)
    for learner, found in own.live.items():
        assert str(found.summary["state"]) == "finished"
        assert bool(found.transitions.equals(own.transitions))
        assert not [*found.reader.path.glob("buffer/*")]  # no second copy
        assert found.reader.snapshot_steps()[-1] == 1200
        assert len(found.reader.profiles().env_step) <= 1200 // 400
        rows[learner] = found.rows()
        # Exams: of each fit but the last, on the rows since.
        exams = found.metrics["exam/footprint_uniform"].notna()
        assert int(exams.to_numpy().sum()) == len(found.reader.profiles().env_step) - 1
    # PMAC in closed form: every row has a policy of its own, and recency counts.
    decay, order = 0.996, np.arange(1200)
    if envs > 1:  # the record has one episode of ten steps after the other
        order = order.reshape(60, 10, envs).transpose(0, 2, 1).reshape(-1)
    share = decay ** (1199.0 - order)
    share[order > 0] *= 1 - decay
    np.testing.assert_allclose(rows["pmac"]["weight"], share / share.mean(), rtol=1e-4)
    given = np.empty(1200)
    given[order] = share / share.mean()
    np.testing.assert_allclose(run.latest_weights("pmac"), given, rtol=1e-4)
    weights = rows["tom"]["weight"].to_numpy()
    assert abs(weights.mean() - 1) < 1e-3
    assert weights[-300:].mean() > weights[:300].mean()  # where the policy is
    assert "policy_distance" in rows["tom"]


@pytest.mark.parametrize("learner", ["pdml", "policy-distance", "action-ratio", "pmer", "none"])
def test_a_learner_that_needs_more_than_a_loop_hands_in_is_refused(learner: str, tmp_path: Path):
    with record("mine", env="Pendulum-v1", store=tmp_path) as run, pytest.raises(UserError):
        weigh_live(run, ("mle", learner))
    assert not run.live


def test_values_that_nobody_handed_in_are_missed_in_a_notice(tmp_path: Path):
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        hand_in(run, 60)
        live = weigh_live(run, ("vagram",), every=50)
    live.wait(PATIENCE_S)
    found = loaded(tmp_path).live["vagram"].reader
    assert [notice["code"] for notice in found.notices()] == ["no-critics"]


def test_a_weighing_that_fails_is_told_at_the_end(tmp_path: Path):
    run = record("mine", env="Pendulum-v1", store=tmp_path)
    hand_in(run, 200)
    (run.path / layout.policy(200)).write_bytes(b"no policy")
    live = weigh_live(run, ("mle",), every=100)
    wait_for(live.failed, PATIENCE_S)
    with pytest.warns(UserWarning, match="live weighing failed"):
        run.close()
    assert str(loaded(tmp_path).summary["state"]) == "finished"
    assert str(loaded(tmp_path).live["mle"].summary["state"]) == "failed"


def test_a_run_that_ends_while_it_is_looked_at_has_not_ended_unfinished(tmp_path, monkeypatch):
    run, held = record("mine", env="Pendulum-v1", store=tmp_path), lock.is_held
    hand_in(run, 60)

    def ends(path: Path) -> bool:
        run.close()
        return held(path)

    monkeypatch.setattr(lock, "is_held", ends)
    follow(RunReader(run.path), ("mle",), every=50, began_at=0)
    found = loaded(tmp_path).live["mle"]
    assert str(found.summary["state"]) == "finished"
    assert found.reader.snapshot_steps() == [60]


def test_many_rows_at_once_are_not_taken_for_a_loop_that_is_too_fast(tmp_path, monkeypatch):
    run, held = record("mine", env="Pendulum-v1", store=tmp_path, envs=2), lock.is_held
    loop = iter([lambda: hand_in(run, 100, 2), lambda: hand_in(run, 200, 2), run.close])

    def looked_at(path: Path) -> bool:
        next(loop)()
        return held(path)

    monkeypatch.setattr(lock, "is_held", looked_at)
    follow(RunReader(run.path), ("mle",), every=100, began_at=0)
    found = loaded(tmp_path).live["mle"].reader
    assert found.profiles().count.tolist() == [100, 300]
    assert "behind" not in {notice["code"] for notice in found.notices()}


@pytest.mark.slow
def test_a_run_that_goes_on_is_weighed_from_there(tmp_path: Path):
    for _ in range(2):
        resume = {"resume": "auto", "step": 300} if (tmp_path / "mine").exists() else {}
        with record("mine", env="Pendulum-v1", store=tmp_path, **resume) as run:
            hand_in(run, 400)
            live = weigh_live(run, ("mle",), every=100)
        live.wait(PATIENCE_S)
    own = loaded(tmp_path)
    found = own.live["mle"]
    assert len(own.transitions) == 700
    fits = found.reader.profiles().env_step.tolist()
    assert fits == [700]  # not that of rows that were cut off
    assert found.reader.snapshot_steps() == fits


def hand_in_unevenly(run: OwnRun, until: int) -> None:
    """Two environments' rows; those of the first, with episodes of 100, are recorded later."""
    while run.step < until:
        obs, no, t = np.full((2, 3), run.step / 10), np.zeros(2, bool), run.step // 2
        ended = np.array([t % 100 == 99, t % 10 == 9])
        run.transitions(obs, np.zeros((2, 1)), np.zeros(2), obs + 0.1, no, ended)
    run.policy(run.step, act)


def test_a_loop_is_weighed_with_the_rows_that_were_handed_in_by_a_step(tmp_path: Path):
    with record("mine", env="Pendulum-v1", store=tmp_path, envs=2) as run:
        for step in (150, 300):
            hand_in_unevenly(run, step)
    handed = RunReader(run.path).buffer()[1]
    weighing = tom.weigh("mine", "mine", store=tmp_path, step=150, learners=["mle"], footprint=50)
    rows = weighing.transitions
    # The second environment's; the first one's were recorded after later ones of the second.
    assert handed[:76].tolist() == [*range(2, 153, 2)]
    assert len(rows) == weighing.report["end"] == 75
    weighing.save(tmp_path / "weighings" / "made")
    again = tom.load(tmp_path / "weighings" / "made")
    assert isinstance(again, Weighing)
    assert again.transitions.equals(rows)


def test_live_weights_of_rows_that_were_cut_out_of_the_record_go(tmp_path: Path):
    def weigh(live: _LearnerRecord) -> None:
        source = RunReader(tmp_path / "mine")
        policy = read_arrays(source.path / layout.policy(source.policy_steps()[-1]))
        live.weigh(*source.buffer(), policy)

    with record("mine", env="Pendulum-v1", store=tmp_path, envs=2) as run:
        live = _LearnerRecord(RunReader(run.path), "pmac", 100, run.began_at)
        with live.recorder:
            for step in (180, 300):
                hand_in_unevenly(run, step)
                weigh(live)
        found = RunReader(live.recorder.writer.path)
        # The second environment's rows of 18 episodes; 300 hands in the first one's as well.
        assert found.snapshot_steps() == [180, 300]
        assert found.profiles().rows.tolist() == [90, 250]
    resume = {"resume": "auto", "step": 260}
    with record("mine", env="Pendulum-v1", store=tmp_path, envs=2, **resume) as run:
        assert run.step == 260
        live = _LearnerRecord(RunReader(run.path), "pmac", 100, run.began_at)
        with live.recorder:  # of the 250 rows that were weighed some had a number above 260
            assert RunReader(live.recorder.writer.path).snapshot_steps() == [180]
