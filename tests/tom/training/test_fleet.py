"""A member of a fleet trains as it would alone, and its run folder is that of an ordinary run."""

from pathlib import Path

import numpy as np
import pytest

from tom.data.unpack import read_arrays
from tom.errors import DivergedError, UserError
from tom.events import Event
from tom.learners import LEARNER_NAMES
from tom.record import RunReader, Store, layout
from tom.record.writer import RunWriter
from tom.training.fleet import train_fleet
from tom.training.plan import Trial
from tom.training.run import Stop, train

# Short: what the order of a sum changes in the last bit grows from episode to episode.
STEPS = 270
SETTINGS = {
    "steps": STEPS,
    "fit_every": 25,
    "tom": {"warmup": 20},
    "evaluation": {"every": 50, "episodes": 2},
    "matmul": "default",
}


def trial(learner: str, seed: int = 0, env: str = "inverted-pendulum", **more: object) -> Trial:
    return Trial(env, learner, seed, "smoke", {**SETTINGS, **more})


MEMBERS = [trial(name, seed) for name in ("mle", "tom") for seed in (0, 1, 2)]
OTHERS = [
    *(trial(name) for name in LEARNER_NAMES if name not in ("mle", "tom")),
    trial("mle", 3, replay_capacity=60),  # less than the exploration
]


def readers(found: list[RunReader | Exception]) -> list[RunReader]:
    assert all(isinstance(one, RunReader) for one in found), found
    return [one for one in found if isinstance(one, RunReader)]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> list[RunReader]:
    store = Store(tmp_path_factory.mktemp("fleet"))
    return readers(train_fleet([*MEMBERS, *OTHERS], store, rerun=False))


def assert_close(first: RunReader, second: RunReader, rtol: float) -> None:
    assert first.status.state == second.status.state == "finished"
    (a, versions_a), (b, versions_b) = first.buffer(), second.buffer()
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=rtol)
    np.testing.assert_array_equal(a.terminated, b.terminated)
    np.testing.assert_array_equal(versions_a, versions_b)
    np.testing.assert_allclose(first.profiles().bins, second.profiles().bins, rtol, 10 * rtol)
    assert first.evaluation_steps() == second.evaluation_steps()
    assert first.snapshot_steps() == second.snapshot_steps() == first.policy_steps()
    for step in first.policy_steps():
        of = [read_arrays(run.path / layout.policy(step)) for run in (first, second)]
        assert of[0].pop("env") == of[1].pop("env")
        for name, x in of[0].items():
            np.testing.assert_allclose(x, of[1][name], rtol=10 * rtol, atol=10 * rtol)
    ours, theirs = first.metrics(), second.metrics()
    assert ours["env_step"].tolist() == theirs["env_step"].tolist()
    compared = ("model/holdout_nll", "weights/ess", "critic/loss", "rollout/reward")
    for name in (*compared, "exam/error", "exam/footprint_uniform", "exam/critic_bias"):
        x, y = (table[name].to_numpy(float) for table in (ours, theirs))
        np.testing.assert_allclose(x, y, rtol=10 * rtol, atol=10 * rtol, err_msg=name)


@pytest.mark.parametrize("member", range(len(MEMBERS) + len(OTHERS)))
def test_a_members_run_is_the_one_trained_alone(fleet, member: int, tmp_path: Path):
    own = [*MEMBERS, *OTHERS][member]
    alone = train(own.config, Store(tmp_path), own.run_id, rerun=False)
    assert fleet[member].run_id == own.run_id
    assert fleet[member].config["config"] == alone.config["config"]
    assert fleet[member].buffer_length() == STEPS
    assert_close(fleet[member], alone, rtol=1e-3)


def test_a_fleet_that_was_stopped_goes_on_with_the_same_call(fleet, tmp_path: Path):
    store, stop = Store(tmp_path), Stop()

    def watch(event: Event) -> None:
        if event.env_step == 240 and not stop.asked:
            stop()

    few = [MEMBERS[0], MEMBERS[3], MEMBERS[4]]
    stopped = readers(train_fleet(few, store, False, [(watch,)] * len(few), stop=stop))
    assert {run.status.state for run in stopped} == {"stopped"}
    resumed = readers(train_fleet(few, store, rerun=False))
    assert [run.run_id for run in resumed] == [t.run_id for t in few]
    for one, undisturbed in zip(resumed, (fleet[0], fleet[3], fleet[4]), strict=True):
        assert_close(one, undisturbed, rtol=1e-3)
    again = readers(train_fleet(few, store, rerun=False))  # finished: nothing is trained
    assert [run.path for run in again] == [run.path for run in resumed]


def test_a_longer_fleet_leaves_the_runs_of_a_shorter_one_alone(tmp_path: Path):
    store, stop = Store(tmp_path), Stop()

    def watch(event: Event) -> None:
        if event.env_step == 120 and not stop.asked:
            stop()

    def few(steps: int) -> Trial:
        settings = {**SETTINGS, "exploration_steps": 100, "steps": steps}
        return Trial("inverted-pendulum", "mle", 0, "smoke", settings)

    shorter, longer = few(150), few(175)
    [stopped] = readers(train_fleet([shorter], store, False, [(watch,)], stop=stop))
    [run] = readers(train_fleet([longer], store, rerun=False))
    assert (run.run_id, run.status.env_step) == (longer.run_id, 175)
    assert stopped.status.state == "stopped"
    [finished] = readers(train_fleet([shorter], store, rerun=False))
    assert (finished.run_id, finished.status.env_step) == (shorter.run_id, 150)


def test_a_member_that_another_process_trains_is_left_to_it(tmp_path: Path):
    own = trial("mle", 5, steps=120)
    writer = RunWriter.create(Store(tmp_path), own.run_id, own.config)
    try:
        (found,) = train_fleet([own], Store(tmp_path), rerun=False)
    finally:
        writer.close()
    assert isinstance(found, UserError)
    assert [run.run_id for run in Store(tmp_path).runs()] == [own.run_id]


def test_a_member_without_a_checkpoint_begins_anew_under_its_name(tmp_path: Path):
    own = trial("mle", 5, steps=120)
    RunWriter.create(Store(tmp_path), own.run_id, own.config).close()
    (run,) = readers(train_fleet([own], Store(tmp_path), rerun=False))
    assert (run.run_id, run.status.state) == (own.run_id, "finished")
    assert [one.run_id for one in Store(tmp_path).runs()] == [own.run_id]
    assert (tmp_path / ".trash" / own.run_id / "config.json").exists()


def test_a_member_that_diverges_ends_alone(tmp_path: Path):
    bad = trial("mle", 7, sac={"lr": 1e30})
    found = train_fleet([bad, MEMBERS[0]], Store(tmp_path), rerun=False)
    assert isinstance(found[0], DivergedError)
    assert Store(tmp_path).run(bad.run_id).status.state == "failed"
    assert readers(found[1:])[0].status.state == "finished"


def test_what_cannot_be_a_fleet_is_refused(tmp_path: Path):
    for trials, hint in (
        ([trial("mle"), trial("mle", env="hopper")], "one environment"),
        ([Trial("road-and-rocks", "mle", 0, "smoke", {})], "road-and-rocks"),
        ([trial("mle", device="quantum")], "must be cpu or cuda"),
    ):
        with pytest.raises(UserError, match=hint):
            train_fleet(trials, Store(tmp_path / "none"), rerun=False)
    assert not (tmp_path / "none").exists()
