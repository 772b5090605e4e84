"""What a sweep is to run, from options and YAML; and whose run is whose."""

import re
from pathlib import Path

import pytest
from common import one_line, present

from tom.cli import Parser
from tom.cli.parser import overrides
from tom.cli.train import add_parser
from tom.config import OnlineConfig
from tom.record import Store
from tom.record.export import export_small
from tom.record.writer import RunWriter
from tom.training.plan import checked, read_plan, same_run, trials
from tom.training.presets import resolve

SMALL = {
    "env": ["inverted-pendulum"],
    "learner": ["mle", "tom"],
    "seeds": [0, 1],
    "preset": "smoke",
}


def plan_of(text: str, tmp_path: Path):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    return checked(read_plan(path))


def test_every_env_with_every_learner_and_seed_the_first_seed_first(tmp_path: Path):
    plan = plan_of("env: [hopper, ant]\nlearner: [tom, mle]\nseeds: [0, 1]\n", tmp_path)
    found = [(t.seed, t.env, t.learner) for t in trials(plan)]
    assert found[:4] == [
        (0, "hopper", "tom"),
        (0, "hopper", "mle"),
        (0, "ant", "tom"),
        (0, "ant", "mle"),
    ]
    assert len(found) == 8
    assert len({t.run_id for t in trials(plan)}) == 8


@pytest.mark.parametrize(("written", "seeds"), [("[3, 7, 3]", [3, 7]), ("4", [4])])
def test_seeds_are_those_that_are_named_and_nothing_is_run_twice(
    written: str, seeds: list[int], tmp_path: Path
):
    plan = plan_of(f"env: hopper\nlearner: [tom, tom]\nseeds: {written}\n", tmp_path)
    assert [t.seed for t in trials(plan)] == seeds


def test_numbers_are_numbers_as_in_yaml_1_2(tmp_path: Path):
    text = (
        "env: hopper\nlearner: tom\nsteps: 4000\nsettings: {sac: {lr: 1e-4}, model: {hidden: 32}}\n"
    )
    (trial,) = trials(plan_of(text, tmp_path))
    assert isinstance(trial.config, OnlineConfig)
    assert trial.config.sac.lr == 1e-4
    assert trial.config.model.hidden == 32
    assert trial.config.steps == 4000


def test_the_words_of_a_trial_make_the_same_training(tmp_path: Path):
    text = (
        "env: hopper\nlearner: tom\nseeds: [5]\nsteps: 4000\nsettings:\n"
        "  sac: {lr: 1e-4, target_entropy: null}\n  tom: {discriminator: false}\n"
    )
    (trial,) = trials(plan_of(text, tmp_path))
    words = ["train", *trial.options()]
    parser = Parser()
    add_parser(parser.add_subparsers(), words)
    args = parser.parse_args(words)
    config = resolve(args.env, args.learner, args.preset, overrides(args))
    assert config == trial.config


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("env: hoper\nlearner: tom", "did you mean 'hopper'"),
        ("env: hopper", "learner"),
        ("env: hopper\nlearner: tom\nseeds: []", "seeds"),
        ("env: hopper\nlearner: tom\nlearning_rate: 1", "learning_rate"),
        ("env: hopper\nlearner: tom\nsettings: {sac: {lr: -1}}", "sac.lr"),
        ("env: hopper\nlearner: tom\nsettings: {seed: 3}", "seed"),
        ("env: hopper\nenv: ant\nlearner: tom", "line 2"),
        ("env: !!python/object/apply:os.system ['true']\nlearner: tom", "plan.yaml"),
    ],
)
def test_bad_plans_are_one_line(text: str, named: str, tmp_path: Path):
    with one_line(re.escape(named)):
        trials(plan_of(text, tmp_path))


def test_a_run_is_known_by_its_settings_not_by_its_name(tmp_path: Path):
    store = Store(tmp_path)
    first, second, *_ = trials(checked(SMALL))
    RunWriter.create(store, "by-hand", first.config).close()
    found = present(same_run(first, store.runs()))
    assert found.run_id == "by-hand"
    assert same_run(second, store.runs()) is None
    export_small(found, tmp_path / "copies")  # the newer of the two
    runs = Store(tmp_path / "copies").runs() + store.runs()
    assert same_run(first, runs[:1]) is runs[0]
    assert same_run(first, runs) is runs[1]
    longer = trials(checked({**SMALL, "steps": 700}))[0]
    assert same_run(longer, store.runs()) is None
    assert longer.run_id != first.run_id
