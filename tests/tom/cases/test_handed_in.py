"""What people hand in: each case is read right, refused in one line, or has its notice."""

import json
from pathlib import Path

import line_cases as cases
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from commands import QUICK, code_of
from common import change
from line_cases import FAR, FLAT, LINE, TWICE, Columns, N, good, ordered, without

import tom
from tom.analysis.ordered_data import OrderedData, load_data
from tom.envs import import_task, task
from tom.errors import UserError
from tom.record import RunReader, Store


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for env in (LINE, FAR, FLAT, TWICE):
        import_task(env)


def loaded(columns: Columns, env: str = LINE) -> OrderedData:
    np.savez("data.npz", allow_pickle=True, **columns)
    return load_data("data.npz", Store(Path("runs")), env)


def codes(data: OrderedData) -> list[str]:
    return [code for code, _ in data.card.notices()]


# Data


def test_good_rows_have_no_notice_and_are_counted():
    card = loaded(good()).card
    columns = good()
    terminated, truncated = columns["terminated"], columns["truncated"]
    assert card.notices() == ()
    assert (card.rows, card.breaks) == (N, 0)
    assert (card.terminations, card.truncations) == (terminated.sum(), truncated.sum())
    assert card.episodes == (terminated | truncated)[:-1].sum() + 1
    assert card.starts.largest[0] <= 0.1
    np.testing.assert_allclose(card.obs.high, columns["obs"].max(0))
    np.testing.assert_allclose(card.action.std, columns["action"].std(0), rtol=1e-4)


BREAKS = int(good()["truncated"][:-1].sum())
ENDS, NONE = cases.ends(good()), np.zeros(N, bool)
MASK_ALONE = ["few-rows", "flags", "no-next-obs"]  # it leaves the rows of true ends
SHUFFLED = np.random.default_rng(1).permutation(N)


@pytest.mark.parametrize(
    ("columns", "expected", "breaks"),
    [
        (good() | {"terminated": 1.0 - good()["terminated"]}, ["flags"], None),
        (good() | {"terminated": ENDS}, ["both-flags", "ends-at-limit"], 0),
        (good() | {"truncated": NONE}, ["order"], BREAKS),
        (ordered(good(), SHUFFLED), ["order"], None),
        (cases.next_step_reset(good()), ["order"], 0),
        (good() | {"next_obs": np.roll(good()["obs"], -1, 0)}, ["order"], 0),
        (without("next_obs"), ["no-next-obs"], 0),
        (without("next_obs") | {"terminated": ~good()["terminated"]}, MASK_ALONE, 0),
        (cases.first(1), ["few-rows"], 0),
        (cases.noise(good()), [], 0),
        (without("truncated"), [], 0),
        (good() | {"infos": np.array([{}] * N, object), "name": np.array(["a"] * N)}, [], 0),
    ],
)
def test_rows_that_contradict_themselves_have_their_notice(columns, expected, breaks):
    data = loaded(columns)
    assert codes(data) == expected
    assert breaks in (None, data.card.breaks)


def test_flags_that_are_none_are_refused():
    with pytest.raises(UserError, match="other than 0 and 1"):
        loaded(good() | {"terminated": np.where(good()["terminated"], 1, -1)})


def test_lost_terminations_are_counted():
    data = loaded(without("next_obs"))
    assert data.card.lost == good()["terminated"].sum()


def test_a_version_of_the_policy_is_used():
    data = loaded(good() | {"policy_version": np.arange(N) // 100})
    assert data.policy_version.tolist() == (np.arange(N) // 100).tolist()
    assert loaded(good()).policy_version.tolist() == list(range(1, N + 1))


def test_actions_of_another_scale_are_noticed():
    assert codes(loaded(good(), TWICE)) == ["action-range"]
    doubled = good() | {"action": 2 * good()["action"]}
    assert codes(loaded(doubled, TWICE)) == []


def test_other_columns_of_parquet_are_ignored():
    columns = {n: pa.array(list(v)) if v.ndim == 2 else pa.array(v) for n, v in good().items()}
    half = good()["obs"].astype(np.float16)
    columns |= {"obs": pa.array(list(half)), "other": pa.array([{"a": "b"}] * N)}
    columns["reward"] = columns["reward"].cast(pa.decimal128(12, 6), safe=False)
    pq.write_table(pa.table(columns), "data.parquet")
    data = load_data("data.parquet", Store(Path("runs")), LINE)
    assert codes(data) == []
    np.testing.assert_allclose(data.transitions.obs, half.astype(np.float32))
    np.testing.assert_allclose(data.transitions.reward, good()["reward"], atol=1e-6)


# Scales


@pytest.mark.parametrize(
    ("env", "scale", "offset"),
    [
        (FAR, (1.0, 1.0), (1.7e9, 0.0)),
        (FLAT, (1.0, 1e-7), (0.0, 0.0)),
    ],
)
def test_values_are_told_apart_whatever_their_scale(env, scale, offset):
    data = loaded(cases.moved(scale, offset), env)
    assert codes(data) == ["scale"]
    seen, own = data.transitions.obs.double().numpy(), good()["obs"]
    for d in range(2):
        assert np.corrcoef(seen[:, d], own[:, d])[0, 1] > 0.9999
        assert 0.01 < seen[:, d].std() < 100


def test_an_offset_that_the_task_does_not_have_is_named():
    assert codes(loaded(cases.moved((1.0, 1.0), (1.7e9, 0.0)))) == ["precision"]


# Tasks and rules, in trainings

TRAIN = ["train", "--learner", "tom", "--preset", "smoke", "--no-rerun", "--run-id", "run"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--env", LINE, "--termination", "line_cases:inverted"], {"rule"}),
        *(
            pytest.param(["--env", env, *words], expected, marks=pytest.mark.slow)
            for env, words, expected in (
                (LINE, ["--termination", "line_cases:right"], set()),
                (cases.RESTLESS, [], {"seed"}),
                (cases.BOTH, [], {"both-flags", "ends-at-limit"}),
            )
        ),
    ],
)
def test_a_training_notices_a_task_or_rule_that_is_wrong(words, expected, capsys):
    assert code_of([*TRAIN, *words, "--steps", "400"]) == 0
    lines = Path("runs/run/notices.jsonl").read_text().splitlines()
    assert {json.loads(line)["code"] for line in lines} == expected
    said = capsys.readouterr().err
    assert all(json.loads(line)["message"] in said for line in lines)


def test_a_task_that_is_not_the_recorded_one_is_named(capsys):
    assert code_of([*TRAIN, "--env", LINE, "--steps", "300"]) == 0
    run = RunReader(Path("runs/run").absolute())
    assert codes(load_data("run", Store(Path("runs")), LINE)) == []
    change(run.path / "config.json", task=run.config["task"] | {"rewards": [5.0] * 10})
    assert codes(load_data("run", Store(Path("runs")), LINE)) == ["task"]
    capsys.readouterr()
    code_of(["train", "--env", LINE, "--resume", "run", "--steps", "320", "--no-rerun"])
    notices = RunReader(run.path).notices()
    assert [row["code"] for row in notices] == ["task"]
    assert "rewards" in notices[0]["message"]


# Policies


def saved(network: cases.Network) -> str:
    example = torch.zeros(1, 2, dtype=network.gain.dtype)
    traced = torch.jit.trace_module(network, {"forward": example}, check_trace=False)
    traced.save("policy.pt")
    return "policy.pt"


@pytest.mark.parametrize(
    ("network", "spread"),
    [(cases.Network, None), (cases.Deviating, "policy-spread"), (cases.Valued, "policy-spread")],
)  # fmt: skip
def test_a_second_output_that_is_no_log_std_is_noticed(network, spread):
    report = tom.weigh(
        "data.npz" if loaded(good()) else "", saved(network()), env=LINE, learners=("mle",),
        seeds=(0,), footprint=60,
    ).report  # fmt: skip
    assert [notice["code"] for notice in report["card"]["notices"]] == ([spread] if spread else [])
    assert report["card"]["policy"]["return"] is not None


def test_a_policy_of_another_scale_is_noticed():
    for name, env, expected in (
        (saved(cases.Acting()), TWICE, True),
        (saved(cases.Acting()), LINE, False),
        ("line_cases:outside", LINE, True),
    ):
        doubled = good() | {"action": task(env).action_bounds[1] * good()["action"]}
        np.savez("data.npz", allow_pickle=False, **doubled)
        found = tom.weigh("data.npz", name, env=env, learners=("mle",), seeds=(0,), footprint=20)
        codes = [notice["code"] for notice in found.card["notices"]]
        assert codes == (["policy-range"] if expected else [])


def test_the_card_is_printed_stored_and_returned(capsys):
    np.savez("data.npz", allow_pickle=False, **cases.first(1))
    words = ["weigh", "data.npz", "--policy", saved(cases.Network()), "--env", LINE, *QUICK]
    assert code_of([*words, "--seeds", "0", "--json"]) == 0
    printed = capsys.readouterr()
    card = json.loads(printed.out)["card"]
    assert (card["rows"], card["episodes"], card["breaks"]) == (1, 1, 0)
    assert [notice["code"] for notice in card["notices"]] == ["few-rows", "uniform"]
    assert all(notice["text"] in printed.err.splitlines() for notice in card["notices"])
