"""Any learner's weights for recorded data, given a policy of interest.

The data may be a run's replay buffer or a dataset. The policy may come from a run, act at random or
come from another library. The policy's footprint is collected in the real environment.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.analysis.ordered_data import OrderedData, find_run, load_data
from tom.config import ModelConfig, OnlineConfig, RunConfig, TomConfig
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.dynamics.base import DynamicsModel
from tom.envs import Task, task
from tom.errors import UserError, check_known
from tom.exams.diagnostics import errors_of_rows
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import (
    LEARNERS,
    follows_behaviour,
    follows_value,
    make_learner,
    with_own_settings,
)
from tom.learners.base import FitContext, Weighting, uniform
from tom.learners.behaviour import require_behaviour
from tom.policy.collect import Footprint, footprint
from tom.policy.foreign import ForeignPolicy, foreign_policy, is_foreign
from tom.policy.stored import NAME, StoredPolicy, UniformPolicy, distances, read_policy
from tom.readable import in_words
from tom.record import Store, layout
from tom.rng import Streams
from tom.training import presets
from tom.training.resume import recorded_config

RANDOM = "random"
CARD_ROWS = 1000
"""observations of the data that a policy is asked about, for its card"""
PolicyOfInterest = StoredPolicy | UniformPolicy | ForeignPolicy
POLICIES = (
    "a run (id or folder), its policy.npz, a TorchScript (.pt) or ONNX file, a function "
    f"module:name, or {RANDOM}"
)
PAST_WARM_UP = sys.maxsize
"""on-policy steps of recorded data: every learner weighs it at once"""
OWN, EXACT = "own", "exact"
PRESETS = (OWN, EXACT, "paper", "mended", "released")
"""the run's own settings, TOM's `exact` ones, or the learners' of a training's preset"""


@dataclass(frozen=True)
class Weighed:
    """One learner's weights (N,) under one seed, mean 1.

    `match` is the distance of the weighted data to fresh episodes of the policy
    (`tom.exams.energy`).
    """

    learner: str
    seed: int
    weights: NDArray[np.float32]
    log_ratio: NDArray[np.float32] | None
    metrics: dict[str, float]
    notices: tuple[tuple[str, str], ...]
    footprint_return: float | None  # mean return of the footprint's whole episodes
    match: dict[str, float] = field(default_factory=dict)
    terms: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    """the other terms of each weight (`tom.learners.terms`), if it comes from a dual Q"""


def load_policy(name: str, store: Store, task: Task, step: int | None = None) -> PolicyOfInterest:
    """The policy `name`, which is one of POLICIES. Raises UserError.

    `step` selects the policy that a run had at the model fit of that env step.
    """
    if name == RANDOM:
        return UniformPolicy(task.obs_dim, task.action_dim)
    run = None if is_foreign(name) else find_run(name, store)
    if run is None and step is not None:
        raise UserError(
            f"--step {step} is a step of a run, and policy {name} is not one: name a run"
        )
    if is_foreign(name):
        return foreign_policy(name, task)
    path = Path(name)
    if run is not None:
        if not run.has_policy(step):
            kept = ", ".join(map(str, run.policy_steps())) if run.fits_model else ""
            advice = f"--step takes one of {kept}" if kept else "name another run"
            of = "its end" if step is None else f"step {step}"
            raise UserError(f"run {run.run_id} kept no policy of {of}: {advice}")
        path = run.path / (NAME if step is None else layout.policy(step))
    policy = read_policy(path)
    of, own = ((x.obs_dim, x.action_dim) for x in (policy, task))
    if (policy.env, of) != (task.name, own):
        raise UserError(
            f"policy {name} is of {policy.env}, not of {task.name} ({of[0]} observations and "
            f"{of[1]} actions, not {own[0]} and {own[1]}): name a policy of {task.name}"
        )
    return policy


def weigh(
    data: OrderedData,
    policy: PolicyOfInterest,
    known: Task,
    config: RunConfig,
    learners: Sequence[str],
    seeds: Sequence[int],
    footprint_rows: int = 1000,
    stepped: Callable[[], None] = lambda: None,
) -> Iterator[Weighed]:
    """Compute every learner's weights under every seed and yield each when it is ready.

    A seed fixes the footprint (the policy's sampled actions in the real environment), a learner's
    random draws, and equally many fresh transitions that no learner has seen, which test the
    weights. `stepped` is called after each step in the real environment, 2 `footprint_rows` times
    per seed.
    """
    rows, scaling = data.transitions, step_scaling(data.transitions)
    for seed in seeds:
        made, fresh = (
            collect_footprint(known, policy, footprint_rows, seed, use, stepped)
            for use in ("footprint", "fresh episodes")
        )
        ours, judges = (episodes.transitions.torch() for episodes in (made, fresh))
        for name in learners:
            own = config.but(learner=name, seed=seed)
            weighting = fit_weights(data, policy, ours, PAST_WARM_UP, own)
            event, generator = weighting.event(0), Streams(seed).torch("exam")
            counted = weighting.counted(model_config(own))  # as in the exam of a training's fit
            yield Weighed(
                learner=name,
                seed=seed,
                weights=event.weight,
                log_ratio=event.log_ratio,
                metrics=dict(weighting.metrics),
                notices=tuple(weighting.notices),
                footprint_return=float(np.mean(made.returns)) if made.returns else None,
                match=footprint_match(rows, counted, judges, scaling, generator),
                terms=dict(event.terms),
            )


def collect_footprint(
    task: Task,
    policy: PolicyOfInterest,
    rows: int,
    seed: int,
    use: str = "footprint",
    stepped: Callable[[], None] = lambda: None,
) -> Footprint:
    """Transitions of the policy in the real environment, reproducible for each seed and `use`."""
    streams = Streams(seed)
    start, draws = streams.integer(f"{use} env"), streams.torch(use)
    return footprint(task, policy, rows, start, draws, stepped)


def fit_weights(
    data: OrderedData,
    policy: PolicyOfInterest,
    policy_buffer: TensorTransitions,
    on_policy_steps: int,
    config: RunConfig,
) -> Weighting:
    """The weights that `config.learner` gives the data in one fit, from new networks."""
    rows, streams = data.transitions, Streams(config.seed)
    dims = rows.obs.shape[1], rows.action.shape[1]
    learner = make_learner(config.learner, config, *dims, streams.torch("learner"))

    def model_errors() -> Tensor:
        """Of a model fitted to the rows without weights, in place of a training's last; (N,)."""
        model = fit_model(rows, uniform(rows, ready=True), model_config(config), config.seed)
        return errors_of_rows(model, rows)

    return learner.weigh(
        FitContext(
            replay=rows,
            policy_version=data.policy_version,
            policy_buffer=policy_buffer,
            on_policy_steps=on_policy_steps,
            initial_obs=data.initial_obs,
            policy=policy,
            generator=streams.torch("weigh"),
            value_gradient=policy.value_gradient,
            behaviour=data.behaviour,
            model_errors=model_errors,
        )
    )


def model_config(config: RunConfig) -> ModelConfig:
    """The model's settings, if there are any."""
    return config.model if isinstance(config, OnlineConfig) else ModelConfig()


def fit_model(
    rows: TensorTransitions, weighting: Weighting, config: ModelConfig, seed: int
) -> DynamicsModel:
    """A new model, fitted to the rows with these weights."""
    streams, dims = Streams(seed), (rows.obs.shape[1], rows.action.shape[1])
    model = make_model(*dims, config, streams.torch("model"))
    model.fit(rows, *weighting.for_fit(config), streams.torch("fit"))
    return model


@dataclass(frozen=True)
class WeighingPlan:
    """Data, policy and settings that belong to the same task."""

    data: OrderedData
    known: Task
    policy: PolicyOfInterest
    config: RunConfig
    preset: str
    learners: tuple[str, ...]
    seeds: tuple[int, ...]
    footprint: int
    changed: Mapping[str, str]
    """the settings that are not the preset's: path to text"""

    def carry_out(self, stepped: Callable[[], None] = lambda: None) -> Iterator[Weighed]:
        """Yield every learner's weights under every seed (`weigh`)."""
        parts = self.data, self.policy, self.known, self.config, self.learners, self.seeds
        return weigh(*parts, self.footprint, stepped)


def plan_weighing(
    data: str,
    policy: str,
    store: Store,
    *,
    learners: Sequence[str],
    seeds: Sequence[int],
    footprint: int,
    env: str | None = None,
    step: int | None = None,
    collected_by: Sequence[str] = (),
    preset: str | None = None,
    settings: Mapping[str, Any],
) -> WeighingPlan:
    """The plan to weigh `data` for `policy`; `tom weigh` documents all.

    `settings` are nested like `RunConfig` and override the preset. Raises UserError, or pydantic's
    ValidationError for a wrong setting.
    """
    if footprint < 1:
        raise UserError(f"a footprint of {footprint} steps is impossible: it takes at least 1")
    rows = _data_for(policy, data, store, env, step)
    known = task(rows.env)
    preset = preset or (EXACT if step is None else OWN)
    usual = _preset_config(preset, rows)
    config = usual.but(**settings)
    before, now = (in_words(one.model_dump(include=setting_groups())) for one in (usual, config))
    for seed in seeds:
        config.but(seed=seed)
    loaded = load_policy(policy, store, known, step)
    if collected_by:
        rows = with_collectors(rows, [load_policy(name, store, known) for name in collected_by])
    check_known("learner", learners, LEARNERS)
    for learner in learners:
        if follows_value(learner) and loaded.value_gradient is None:
            raise UserError(
                f"learner {learner} follows a value function, and this policy comes without one: "
                f"leave {learner} out, or name the policy of a newer run"
            )
        if follows_behaviour(learner):
            require_behaviour(rows.policy_version, rows.behaviour, loaded)
    asked = rows.transitions.obs[:: max(len(rows) // CARD_ROWS, 1)][:CARD_ROWS]
    facts = loaded.facts(asked) if isinstance(loaded, ForeignPolicy) else None
    return WeighingPlan(
        data=replace(
            rows,
            card=replace(rows.card, policy=facts),
            policy_distance=distances(loaded.mean, rows.transitions),
        ),
        known=known,
        policy=loaded,
        config=config,
        preset=preset,
        learners=tuple(dict.fromkeys(learners)),
        seeds=tuple(dict.fromkeys(seeds)),
        footprint=footprint,
        changed={path: value for path, value in now.items() if before.get(path) != value},
    )


def _data_for(
    policy: str, data: str, store: Store, env: str | None, step: int | None
) -> OrderedData:
    """The data, of the task `env`, by default the policy's. Raises UserError if of another."""
    if env is None and policy != RANDOM and not is_foreign(policy):
        run = find_run(policy, store)
        env = read_policy(Path(policy)).env if run is None else run.env
    rows = load_data(data, store, env, step)
    if rows.env != (env or rows.env):
        raise UserError(f"{rows.name} is of {rows.env}, not of {env}: name a policy of {rows.env}")
    return rows


def with_collectors(data: OrderedData, policies: Sequence[PolicyOfInterest]) -> OrderedData:
    """The data with the behaviour of the policies that collected it, the first version's first.

    One policy is that of all rows but exploration. Raises UserError if their number is another than
    that of the versions, or one is no Gaussian.
    """
    obs, versions = data.transitions.obs, data.policy_version
    known = versions[versions != 0].unique()
    numbers = (versions != 0).to(torch.int64) if len(policies) == 1 else versions
    if not len(known) or len(policies) not in (1, len(known)):
        raise UserError(
            f"--collected-by names {len(policies)} policies, and {data.name} was collected by "
            f"{len(known)}: name one for each policy_version above 0, or one for all"
        )
    behaviour = obs.new_full((len(obs), 2 * data.transitions.action.shape[1]), torch.nan)
    for version, policy in zip(numbers[numbers != 0].unique(), policies, strict=True):
        own = numbers == version
        gaussian = require_behaviour(versions[:0], None, policy).gaussian(obs[own])
        behaviour[own] = torch.cat(gaussian, 1)
    return replace(data, behaviour=behaviour)


def _preset_config(preset: str, data: OrderedData) -> RunConfig:
    """The settings of every learner that `preset` stands for."""
    check_known("preset", [preset], PRESETS)
    if preset == EXACT:
        return settings_type()(env=data.env, learner="tom", tom=TomConfig.preset(EXACT))
    if preset == OWN:
        if data.run is None:
            raise UserError(
                f"{data.name} is not a run, so it has no settings: --preset exact, paper or mended"
            )
        source = recorded_config(data.run, "name --preset exact, paper or mended")
    else:
        source = presets.resolve(data.env, "tom", preset)
    own = {group: getattr(source, group) for group in setting_groups() if hasattr(source, group)}
    return settings_type()(env=source.env, learner="tom", **own)


def settings_type() -> type[RunConfig]:
    """The configuration class with the settings of every plug-in's learner."""
    return with_own_settings(RunConfig, LEARNERS)


def setting_groups() -> set[str]:
    """The names of the groups of learners' settings."""
    return {entry.group for entry in LEARNERS.values() if entry.group}
