"""What weights do for the policy: SAC goes on from a kept policy in models of the frozen buffer."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tom.cli import main
from tom.data.transitions import TensorTransitions
from tom.data.unpack import read_arrays
from tom.policy.stored import StoredPolicy, policy_arrays, resumed_sac
from tom.record import RunReader, Store, layout
from tom.studies import improvement as study
from tom.studies.frozen import Case, moments
from tom.studies.improvement import Improvement, Trial, gain, improved
from tom.training.presets import resolve
from tom.training.run import train

SMALL = {"steps": 1500, "snapshots": 10, "sac": {"hidden": 16, "batch_size": 32}}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    config = resolve("hopper", "mle", "smoke", SMALL)
    return train(config, Store(tmp_path_factory.mktemp("store")), "frozen", rerun=False)


def arrays_of(run: RunReader) -> dict:
    return dict(read_arrays(run.path / layout.policy(moments(run, 1)[0])))


def test_sac_goes_on_with_the_stored_networks(run: RunReader):
    arrays, config = arrays_of(run), resolve("hopper", "mle", "smoke", SMALL).sac
    sac = resumed_sac(arrays, config, 0.25, torch.Generator().manual_seed(0))
    for name, array in policy_arrays("hopper", sac).items():
        assert np.array_equal(array, arrays[name]), name
    obs, action = torch.randn(7, 11), torch.rand(7, 3) * 2 - 1
    assert torch.equal(sac.member().mean(obs), StoredPolicy(arrays).mean(obs))
    inputs = torch.cat([obs, action], -1).expand(2, -1, -1)
    assert torch.equal(sac.critic(inputs), sac.target_critic(inputs))
    assert sac.log_temperature.exp().item() == pytest.approx(0.25)
    batch = TensorTransitions(
        obs, action, torch.zeros(7), obs.clone(), torch.zeros(7), torch.zeros(7)
    )
    before = sac.critic(inputs).clone()
    sac.updates(batch.packed()[None, None])
    assert not torch.equal(sac.critic(inputs), before)
    assert np.array_equal(arrays_of(run)["weight_0"], arrays["weight_0"])  # the file's own arrays


def test_a_file_without_critics_or_with_other_layers_is_refused(run: RunReader):
    arrays, config = arrays_of(run), resolve("hopper", "mle", "smoke", SMALL).sac
    generator = torch.Generator().manual_seed(0)
    alone = {name: a for name, a in arrays.items() if not name.startswith("critic_")}
    with pytest.raises(ValueError, match="holds no layers"):
        resumed_sac(alone, config, 1.0, generator)
    with pytest.raises(RuntimeError):
        resumed_sac(arrays, config.model_copy(update={"hidden": 8}), 1.0, generator)


def trial(run: RunReader, way: str, updates: int = 20) -> Trial:
    case = Case(run.path, moments(run, 1)[0], way, models=("linear",))
    return Trial(case, updates, episodes=2)


def test_weights_act_in_the_model_in_the_starts_or_in_both(run: RunReader):
    plain, newest = improved(trial(run, "uniform")), improved(trial(run, "newest"))
    assert plain.model == plain.starts == plain.both
    assert plain.both != plain.before
    assert newest.before == plain.before  # the same policy and start states
    assert len({newest.model, newest.starts, newest.both, plain.both}) == 4
    assert improved(trial(run, "newest")) == newest


def test_the_policy_before_is_the_stored_one(run: RunReader):
    """With so few updates the return has hardly moved."""
    few = improved(trial(run, "uniform", updates=study.PARTS))
    assert few.both == pytest.approx(few.before, rel=0.2)


def test_a_gain_by_hand():
    assert gain(110, 90) == pytest.approx(0.2)
    assert gain(90, 110) == pytest.approx(-0.2)
    assert gain(-90, -110) == pytest.approx(0.2)
    assert gain(0, 0) == 0


BASE = Improvement("a", "hopper", 100, "uniform", 0, 90, 110, 110, 110)


def found() -> list[Improvement]:
    way = replace(BASE, way="ratio", model=90, starts=110, both=330)
    return [
        BASE,
        way,
        replace(BASE, recording="b", before=110),
        replace(way, recording="b", model=110),
        replace(way, recording="c"),  # without uniform weights to compare with
    ]


def test_a_summary_by_hand():
    uniform, model, starts, both = study.summary(found())
    assert uniform["gain"] == pytest.approx((0.2 + 0) / 2)
    assert (uniform["better at"], uniform["n"]) == (1, 2)
    assert model["gain"] == pytest.approx((-0.2 + 0) / 2)
    assert (model["low"], model["high"]) == pytest.approx((-0.2, 0))
    assert (starts["gain"], starts["better at"]) == (0, 0)
    assert (both["gain"], both["better at"], both["n"]) == (1, 2, 2)
    assert both["hopper"] == 1
    said = study.verdict(found())
    assert "+0.10 [+0.00, +0.20], better at 1 of 2" in said[0]
    assert said[1].startswith("ratio, weights in the model alone: -0.10")
    assert said[1].endswith("No difference beyond it.")
    assert said[3].endswith("A gain beyond the interval.")


def test_the_command_writes_its_report(
    run: RunReader, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "improvement"
    words = ["reproduce", "improvement", "frozen", "--model", "linear", "--ways", "newest"]
    words += ["--updates", "5", "--episodes", "1", "--moments", "1", "--jobs", "1", "--json"]
    words += ["--store", str(run.path.parent), "--out", str(out)]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["weights in"] for row in told["summary"][1:]] == ["model", "starts", "both"]
    assert {path.name for path in out.glob("*.*")} == {
        "report.html", "report.json", "summary.csv", "moments.csv", "improvement.png",
        "improvement.svg",
    }  # fmt: skip
    assert list(pd.read_csv(out / "moments.csv")["way"]) == ["uniform", "newest"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--model", "9 x 9"], "unknown model '9 x 9'"),
        (["--updates", "4"], "--updates must be at least 5"),
        (["--moments", "0"], "--moments must be at least 1"),
        (["--ways", "tom-mendet"], "did you mean 'tom-mended'"),
    ],
)
def test_bad_input_is_one_line(
    run: RunReader, words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "report"
    asked = [*words, "--store", str(run.path.parent), "--out", str(out)]
    assert main(["reproduce", "improvement", *asked]) == 2
    assert says in capsys.readouterr().err
    assert not out.exists()


def test_policies_without_critics_are_refused(
    run: RunReader, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    older = Store(tmp_path / "store").path / "older"
    older.parent.mkdir()
    shutil.copytree(run.path, older)
    for path in (older / "policies").iterdir():
        kept = {n: a for n, a in read_arrays(path).items() if not n.startswith("critic_")}
        np.savez(path, allow_pickle=False, **kept)
    words = ["reproduce", "improvement", "--store", str(older.parent), "--out", str(tmp_path / "o")]
    assert main(words) == 2
    assert "run older kept no critics" in capsys.readouterr().err
