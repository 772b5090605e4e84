"""`tom weigh` and `tom reproduce progression` on small real runs and files."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from commands import QUICK, code_of, refused
from common import one_line
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.wrappers import RescaleAction

from tom.analysis import weighing
from tom.analysis.ordered_data import load_data, load_run
from tom.analysis.weighing import plan_weighing
from tom.cli import main
from tom.config import PmacConfig, RunConfig
from tom.data.sampling import bin_means
from tom.data.transitions import Transitions
from tom.envs import task
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import follows_behaviour
from tom.learners.base import Weighting
from tom.learners.pmac import recency_probabilities
from tom.policy.collect import Footprint, footprint
from tom.policy.stored import UniformPolicy
from tom.record import RunReader, Store
from tom.reports.weighing_files import ROWS
from tom.reports.weighing_files import of_run as weighings_of
from tom.studies.progression import undo_shuffle
from tom.training.presets import resolve

STEPS = 300


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of SAC called `sac` and an ordinary training called `trained`."""
    path = tmp_path_factory.mktemp("store")
    shared = ["--env", "inverted-pendulum", "--store", str(path), "--no-rerun"]
    small = ["--sac.hidden", "16", "--evaluation.episodes", "1"]
    sac = ["--steps", str(STEPS), "--exploration-steps", "100", "--run-id", "sac", *small]
    assert main(["record-sac", *shared, *sac]) == 0
    online = ["--learner", "mle", "--preset", "smoke", "--steps", "250", "--run-id", "trained"]
    assert main(["train", *shared, *online]) == 0
    return path


def weigh(store: Path, *arguments: str) -> int:
    return code_of(["weigh", *QUICK, *arguments, "--store", str(store)])


def test_every_file_of_a_weighing(store: Path, tmp_path: Path, capsys):
    out = tmp_path / "out"
    code = weigh(store, "sac", "--policy", "sac", "--seeds", "0", "5", "--bins", "50",
                 "--out", str(out), "--json")  # fmt: skip
    assert code == 0
    report = json.loads(capsys.readouterr().out)
    assert {p.name for p in out.iterdir()} == {
        "weights.parquet", "profile.csv", "profile.png", "profile.svg", "report.json",
    }  # fmt: skip
    weights = pq.read_table(out / "weights.parquet").to_pandas()
    assert len(weights) == 2 * STEPS
    for seed in (0, 5):
        for learner in ("tom", "pmac", "mle"):
            assert weights[f"{learner}-s{seed}"].dtype == np.float32
            assert weights[f"{learner}-s{seed}"].mean() == pytest.approx(1, abs=1e-4)
        assert f"tom-s{seed}-log_ratio" in weights
    assert not np.array_equal(weights["tom-s0"], weights["tom-s5"])
    _, version = RunReader(store / "sac").buffer()
    by_recency = recency_probabilities(torch.from_numpy(version), 0.996) * len(version)
    np.testing.assert_allclose(weights["pmac-s0"], by_recency, rtol=1e-5)
    lines = (out / "profile.csv").read_text().splitlines()
    assert len(lines) == 1 + 6 * 50
    expected = bin_means(weights["tom-s0"].to_numpy(copy=True), 50)
    assert float(lines[1].split(",")[3]) == pytest.approx(float(expected[0]), rel=1e-5)
    assert report["ordered_from"] == STEPS
    assert report["medians"]["mle"]["random_mean"] == pytest.approx(1)
    assert report["medians"]["pmac"]["last_two"] > report["medians"]["pmac"]["random_mean"]
    assert set(report["made"]) == {"command", "git_commit", "versions", "hours"}


def test_weights_are_judged_by_episodes_that_no_learner_has_seen(store: Path, monkeypatch):
    data, known = load_run(RunReader(store / "sac")), task("inverted-pendulum")
    rows, seen = data.transitions, []
    far = torch.arange(len(data))[:, None] < STEPS  # the random half is somewhere else
    moved = replace(
        rows, obs=torch.where(far, 5.0, rows.obs), next_obs=torch.where(far, 5.0, rows.next_obs)
    )

    def watched(*given) -> Footprint:
        seen.append(footprint(*given))
        return seen[-1]

    monkeypatch.setattr(weighing, "footprint", watched)
    config = RunConfig(env=known.name, learner="pmac", pmac=PmacConfig(decay=0.97))
    judged, policy = replace(data, transitions=moved), UniformPolicy(4, 1)
    mle, pmac = weighing.weigh(judged, policy, known, config, ["mle", "pmac"], [0], 200)
    learnt, fresh = (made.transitions.obs for made in seen)
    assert len(learnt) == len(fresh) == 200
    assert not np.isin(np.asarray(learnt)[:, 0], np.asarray(fresh)[:, 0]).any()
    assert mle.match["footprint"] == 1.0
    assert mle.match["footprint_uniform"] == pmac.match["footprint_uniform"]
    kept = torch.from_numpy(pmac.weights) * ~far[:, 0]
    assert float(kept.sum()) == pytest.approx(len(data), rel=0.03)  # recency: all in the other
    assert pmac.match["footprint"] < 0.3
    again = footprint_match(
        moved,
        torch.from_numpy(pmac.weights),
        seen[1].transitions.torch(),
        step_scaling(moved),
        torch.Generator(),
    )
    assert pmac.match["footprint"] == pytest.approx(again["footprint"], abs=0.02)


def test_weights_are_judged_as_a_fit_counts_them(store: Path, monkeypatch):
    data, known = load_run(RunReader(store / "sac")), task("inverted-pendulum")
    raw = torch.from_numpy(np.random.default_rng(0).lognormal(0, 3, len(data))).float()
    heavy, made = Weighting(raw / raw.mean(), clipped=True), []
    judge = weighing.footprint_match
    monkeypatch.setattr(weighing, "fit_weights", lambda *_: heavy)
    monkeypatch.setattr(
        weighing, "footprint_match", lambda *given: made.append(given[1]) or judge(*given)
    )
    config = RunConfig(env=known.name, learner="tom")
    (found,) = weighing.weigh(data, UniformPolicy(4, 1), known, config, ["tom"], [0], 100)
    assert float(heavy.weights.max()) > 10 >= float(made[0].max())
    assert found.weights == pytest.approx(heavy.weights.numpy())  # what is kept is not cut


def test_a_weighing_lies_in_the_store_and_goes_with_a_small_copy(
    store: Path, tmp_path: Path, capsys
):
    assert weigh(store, "sac", "--policy", "sac", "--seeds", "0", "--json") == 0
    made = Path(json.loads(capsys.readouterr().out)["out"])
    assert made.parent == store / "weighings"
    assert Store(store).problems == []
    words = ["runs", "export", "--small", "--store", str(store), "--out", str(tmp_path)]
    assert main([*words, "--keep", "buffer", "policy"]) == 0
    (copy,) = (tmp_path / "weighings").iterdir()
    assert {p.name for p in copy.iterdir()} == {p.name for p in made.iterdir()} - {"profile.svg"}
    whole, small = (pq.read_table(path / "weights.parquet") for path in (made, copy))
    assert set(small.column_names) == {"tom-s0", "pmac-s0", "mle-s0", "policy_distance"}
    np.testing.assert_allclose(small["tom-s0"], whole["tom-s0"], rtol=1e-3)
    assert main(["runs", "index", "--store", str(tmp_path)]) == 0
    page = (tmp_path / "README.md").read_text()
    assert f"| `{made.name}` | `sac` | `sac` | TOM, PMAC, MLE | 0 | {2 * STEPS} |" in page
    assert weigh(tmp_path, "sac", "--policy", "sac", "--learner", "mle", "--seeds", "0") == 0


@pytest.mark.parametrize(
    ("learner", "capacity"),
    [
        ("policy-distance", 210),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("vagram", 1000), ("pdml", 1000))),
    ],
)
def test_at_a_step_the_weights_are_those_that_the_run_had(tmp_path: Path, learner, capacity):
    words = ["--env", "inverted-pendulum", "--learner", learner, "--preset", "smoke"]
    steps = ["--steps", "250", "--fit-every", "20", "--replay-capacity", str(capacity)]
    where = ["--run-id", learner, "--store", str(tmp_path), "--no-rerun"]
    soon = [f"--{learner}.warmup", "10"] if follows_behaviour(learner) else []
    assert main(["train", *words, *steps, *where, *soon]) == 0
    run = RunReader(tmp_path / learner)
    assert run.policy_steps() == run.snapshot_steps()
    step = run.policy_steps()[1]
    out = tmp_path / "out"
    chosen = ["--policy", learner, "--learner", learner, "--step", str(step), "--seeds", "0"]
    chosen += ["--footprint", "1000"]  # more rows than the learners' warm-ups take
    assert weigh(tmp_path, learner, *chosen, "--out", str(out)) == 0
    found = pq.read_table(out / "weights.parquet")[f"{learner}-s0"].to_numpy()
    recorded = run.snapshot(step)["weight"].to_numpy()
    assert len(recorded) == min(step, capacity) < 250
    (run.path / "policy.npz").unlink()  # as while it trains
    assert weigh(tmp_path, learner, *chosen, "--out", str(tmp_path / "again")) == 0
    np.testing.assert_allclose(found, recorded, rtol=1e-5)
    report = json.loads((out / "report.json").read_text())
    # the first 200 steps explored, of which the buffer had dropped what was too much for it
    assert (report["step"], report["ordered_from"]) == (step, 200 - max(step - capacity, 0))


def test_at_a_step_a_runs_own_settings_hold(tmp_path: Path, capsys):
    words = ["--env", "inverted-pendulum", "--learner", "pmac", "--preset", "smoke"]
    where = ["--run-id", "own", "--store", str(tmp_path), "--no-rerun"]
    assert main(["train", *words, "--steps", "240", "--pmac.decay", "0.9", *where]) == 0
    run = RunReader(tmp_path / "own")
    step = run.policy_steps()[-1]
    chosen = ["own", "--policy", "own", "--learner", "pmac", "--seeds", "0", "--footprint", "10"]
    weigh_it = ["weigh", *chosen, "--step", str(step), "--store", str(tmp_path), "--json"]
    capsys.readouterr()
    for more, decay in ([], 0.9), (["--pmac.decay", "0.8"], 0.8):
        assert main([*weigh_it, *more, "--out", str(tmp_path / f"out-{decay}")]) == 0
        assert json.loads(capsys.readouterr().out)["config"]["pmac"]["decay"] == decay
    found = pq.read_table(tmp_path / "out-0.9" / "weights.parquet")["pmac-s0"].to_numpy()
    np.testing.assert_allclose(found, run.snapshot(step)["weight"].to_numpy(), rtol=1e-5)


def test_shuffled_rows_come_back_in_order(store: Path):
    """PMAC follows the storage; a row's own weight comes back to its place."""
    data, known = load_run(RunReader(store / "sac")), task("inverted-pendulum")
    order = np.random.default_rng(0).permutation(len(data))
    shuffled = replace(data, transitions=data.transitions[torch.from_numpy(order)])
    config = RunConfig(env=known.name, learner="pmac")
    (one,) = weighing.weigh(shuffled, UniformPolicy(4, 1), known, config, ["pmac"], [0], 10)
    back = undo_shuffle(one, order)
    np.testing.assert_array_equal(back.weights[order], one.weights)
    assert back.weights[order[-1]] == one.weights.max()  # the last one stored counts most


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["sac", "--policy", "nothing"], "no policy at nothing"),
        (["sac", "--policy", "random", "--learner", "vagram"], "without one: leave vagram out"),
        (
            ["trained", "--policy", "trained", "--step", "7"],
            "kept no policy of step 7: --step takes one of 200",
        ),
        (["trained", "--policy", "random", "--step", "251"], "--step 251 is none of them"),
        (["sac", "--policy", "random", "--env", "hopper"], "is of inverted-pendulum, not of"),
        (["sac", "--policy", "random", "--bins", "1000000000"], "--bins"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_made(store, tmp_path, arguments, named, capsys):
    words = ["weigh", *arguments, "--store", str(store), *QUICK, "--out", str(tmp_path / "out")]
    refused(words, capsys, named)
    assert not list(tmp_path.iterdir())


def test_a_policy_of_another_task_of_the_same_size_is_refused(store: Path, tmp_path: Path, capsys):
    with np.load(store / "trained" / "policy.npz") as file:
        arrays = {**file, "env": np.array("hopper")}
    np.savez(tmp_path / "policy.npz", **arrays)
    words = ("--policy", str(tmp_path / "policy.npz"), "--env", "inverted-pendulum")
    assert weigh(store, "trained", *words, "--out", str(tmp_path / "out")) == 2
    assert "is of hopper, not of inverted-pendulum" in capsys.readouterr().err


@pytest.mark.parametrize(("preset", "decay"), [("mended", 0.996), ("released", 0.9)])
def test_a_preset_is_that_of_a_training(preset: str, decay: float, store: Path):
    plan = plan_weighing(
        "trained", "trained", Store(store), learners=["tom"], seeds=[0], footprint=10,
        preset=preset, settings={},
    )  # fmt: skip
    trained = resolve("inverted-pendulum", "tom", preset)
    assert (plan.config.tom, plan.config.pmac) == (trained.tom, trained.pmac)
    assert plan.config.tom.q_hidden == 64  # the task's, as trainings have it
    assert plan.config.pmac.decay == decay


# Data and policies that other libraries made

ENV = "inverted-pendulum"
BOUND = 3.0  # of its actions
N = 300
ONCE = [*QUICK, "--seeds", "0"]


class Policy(torch.nn.Module):
    """Pushes the cart to where the pole leans, a little at random; with a gain below 0 away."""

    def __init__(self, gain: float = 4.0) -> None:
        super().__init__()
        self.gain = gain

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.gain * obs[:, 1:2]
        return mean, torch.full_like(mean, -1.0)


@pytest.fixture(scope="module")
def rows() -> Transitions:
    """Random actions in the task, in [-1, 1]."""
    generator = torch.Generator().manual_seed(0)
    return footprint(task(ENV), UniformPolicy(4, 1), N, 0, generator).transitions


@pytest.fixture
def data(rows: Transitions, tmp_path: Path) -> str:
    columns = {field.name: np.asarray(getattr(rows, field.name)) for field in fields(rows)}
    path = tmp_path / "mine.npz"
    np.savez(path, allow_pickle=False, **columns | {"action": columns["action"] * BOUND})
    return str(path)


@pytest.fixture
def policy(tmp_path: Path) -> str:
    path = tmp_path / "policy.pt"
    torch.jit.script(Policy()).save(str(path))
    return str(path)


def test_own_data_by_an_own_policy(rows, data: str, policy: str, tmp_path: Path, capsys):
    store = tmp_path / "store"
    assert weigh(store, data, "--policy", policy, "--env", ENV, "--seeds", "0", "--json") == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    made = Path(report["out"])
    assert made.parent == store / "weighings"
    assert made.name.startswith("mine-by-policy.pt-")
    assert (report["data"], report["rows"], report["ordered_from"]) == ("mine", N, 0)
    assert {row["learner"] for row in report["results"]} == {"tom", "pmac", "mle"}
    assert "mine: tom seed 0" in printed.err
    footprints = {row["learner"]: row["footprint"] for row in report["results"]}
    assert footprints["mle"] == 1.0
    assert footprints["pmac"] != 1.0
    weights = pq.read_table(made / "weights.parquet").to_pandas()
    assert weights["tom-s0"].mean() == pytest.approx(1, abs=1e-4)
    kept, version = RunReader(made).buffer()
    for field in fields(rows):
        expected = np.asarray(getattr(rows, field.name))
        np.testing.assert_allclose(getattr(kept, field.name), expected, atol=1e-6)
    assert version.tolist() == [*range(1, N + 1)]  # nobody says that a row is exploration's
    assert weighings_of(store, "mine") == []  # it is no run
    assert weigh(store, data, "--policy", "random", "--env", ENV, "--seeds", "0", "--json") == 0
    other = json.loads(capsys.readouterr().out)
    assert other[ROWS] == report[ROWS]


def test_a_weighing_is_data_by_its_name_and_wherever_it_lies(rows, data: str, tmp_path: Path):
    store, words = Store(tmp_path / "store"), ["--policy", "random", "--learner", "mle"]
    for place in ("store/weighings/kept", "elsewhere"):
        made = str(tmp_path / place)
        assert weigh(store.path, data, "--env", ENV, *words, "--seeds", "0", "--out", made) == 0
    for name in ("kept", str(tmp_path / "elsewhere")):
        found = load_data(name, store)
        assert (found.name, found.env, found.run) == ("mine", ENV, None)
        np.testing.assert_allclose(found.transitions.obs, rows.obs)
    (tmp_path / "elsewhere/config.json").unlink()  # as a weighing of a run's buffer
    with one_line():
        load_data(str(tmp_path / "elsewhere"), store)


def test_policies_that_collected_the_data_come_from_a_list_or_from_columns(
    rows: Transitions, policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    columns = {field.name: np.asarray(getattr(rows, field.name)) for field in fields(rows)}
    columns["action"] = columns["action"] * BOUND
    version = np.repeat([0, 3, 4], N // 3)  # exploration, and two policies

    def command(*words: str, **more: np.ndarray) -> list[str]:
        np.savez(tmp_path / "a.npz", allow_pickle=False, policy_version=version, **columns, **more)
        asked = ["weigh", str(tmp_path / "a.npz"), "--policy", policy, "--env", ENV]
        words = ("--learner", "policy-distance", *words)
        # Whoever brings data has no warm-up to wait for.
        return [*asked, "--out", str(tmp_path / "out"), *ONCE, "--tom.warmup", "9", *words]

    def weights(*words: str, **more: np.ndarray) -> np.ndarray:
        assert main(command(*words, **more)) == 0
        found = pq.read_table(tmp_path / "out/weights.parquet")["policy-distance-s0"].to_numpy()
        shutil.rmtree(tmp_path / "out")
        return found

    other = str(tmp_path / "other.pt")
    torch.jit.script(Policy(-1.0)).save(other)
    listed = weights("--collected-by", other, policy)
    mean = np.where(version[:, None] == 3, -1.0, 4.0) * columns["obs"][:, 1:2]
    of_rows = {"behaviour_mean": mean, "behaviour_log_std": np.full_like(mean, -1.0)}
    np.testing.assert_allclose(listed, weights(**of_rows), rtol=1e-5)
    assert (listed[version == 0] == 0).all()
    # The policy of interest itself is at distance 0: 1 / .05; the other's KL is (5 x / s)^2 / 2.
    divergence = (5 * columns["obs"][:, 1] * np.e) ** 2 / 2
    ratio = (1 / (divergence + 0.05))[version == 3] * 0.05
    np.testing.assert_allclose(listed[version == 3] / listed[-1], ratio, rtol=1e-4)
    assert np.ptp(weights("--collected-by", policy)[version > 0]) < 1e-6
    refused(command(), capsys)
    refused(command("--collected-by", policy, policy, policy), capsys)
    version[:] = 0  # nobody's
    refused(command("--collected-by", policy), capsys)
    version[-1] = 1
    of_rows["behaviour_mean"][N - 1] = np.nan
    refused(command(**of_rows), capsys)


def test_what_contradicts_itself_is_told_before_the_work(data: str, tmp_path: Path, capsys):
    columns = dict(np.load(data))
    np.savez(tmp_path / "mask.npz", **columns | {"terminated": ~columns["terminated"]})
    words = (str(tmp_path / "mask.npz"), "--policy", "random", "--env", ENV, "--learner", "mle")
    assert weigh(tmp_path / "store", *words, "--seeds", "0", "--json") == 0
    printed = capsys.readouterr()
    lines = printed.err.splitlines()
    told = [one["text"] for one in json.loads(printed.out)["card"]["notices"]]
    assert told
    for text in told:
        assert lines.count(text) == 1
        assert lines.index(text) < lines.index("mask: mle seed 0")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--policy", "POLICY"], "does not say which task it is of: add --env"),
        (["--policy", "POLICY", "--env", "hopper"], "has 4 observations and 1 actions, hopper has"),
        (["--policy", "POLICY", "--env", ENV, "--step", "9"], "is a step of a run"),
    ],
)
def test_bad_input_about_own_data_is_one_line_and_nothing_is_made(
    data: str, policy: str, tmp_path: Path, words: list[str], named: str, capsys
):
    given = [{"POLICY": policy, "DATA": data}.get(word, word) for word in words]
    where = ["--store", str(tmp_path / "store")]
    refused(["weigh", data, *given, *where, *ONCE], capsys, named)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.npz", "policy.pt"]


@pytest.mark.parametrize(
    ("factor", "code", "named"),
    [(1.0005, 0, ""), (1.5, 2, "row 7: dimension 0 is 4.5, its bounds are -3 and 3")],
)
def test_actions_outside_the_bounds_are_refused(
    factor: float, code: int, named: str, data: str, tmp_path: Path, capsys
):
    columns = dict(np.load(data))
    columns["action"][7] = BOUND * factor
    np.savez(tmp_path / "far.npz", allow_pickle=False, **columns)
    far, words = (
        str(tmp_path / "far.npz"),
        ("--policy", "random", "--env", ENV, "--learner", "mle", "--seeds", "0"),
    )
    assert weigh(tmp_path / "store", far, *words) == code
    assert named in capsys.readouterr().err
    assert (tmp_path / "store").exists() == (code == 0)


def test_bounds_are_those_of_the_task_as_it_is_registered():
    made = "Rescaled-Pendulum-v0"
    gym.register(made, lambda **_: RescaleAction(PendulumEnv(), np.float32(-1), np.float32(1)))
    known = task(f"gymnasium:{made}")  # the innermost Pendulum's bounds are -2 and 2
    action = np.array([[-1.0], [0.0], [0.5]], np.float32)
    np.testing.assert_array_equal(known.unit_action(action), action)
    assert [bound.tolist() for bound in known.action_bounds] == [[-1.0], [1.0]]
