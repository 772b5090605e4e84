"""Any learner's weights for recorded data, given a policy of interest.

The data may be a run's replay buffer or a dataset. The policy may come from a run, act at random or
come from another library. The policy's footprint is collected in the real environment.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tom.analysis.ordered_data import OrderedData, action_bounds, after_random, find_run, load_data
from tom.config import RunConfig, TomConfig, in_words
from tom.envs import GymnasiumTask, Task, task
from tom.errors import UserError, unknown
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import LEARNERS, follows_value, make_learner, with_own_settings
from tom.learners.base import FitContext
from tom.policy.collect import Footprint, footprint
from tom.policy.foreign import ForeignPolicy, foreign_policy, is_foreign
from tom.policy.stored import NAME, StoredPolicy, UniformPolicy, read_policy
from tom.record import RunReader, Store, layout
from tom.rng import Streams
from tom.training import presets
from tom.training.resume import recorded_config

RANDOM = "random"
PolicyOfInterest = StoredPolicy | UniformPolicy | ForeignPolicy
POLICIES = (
    "a run (id or folder), its policy.npz, a TorchScript (.pt) or ONNX file, a function "
    f"module:name, or {RANDOM}"
)


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

    def in_order(self, order: NDArray[np.int64]) -> "Weighed":
        """Undo a permutation: row i of these weights belongs to row order[i]."""
        back = np.argsort(order)
        ratio = None if self.log_ratio is None else self.log_ratio[back]
        terms = {name: term[back] for name, term in self.terms.items()}
        return replace(self, weights=self.weights[back], log_ratio=ratio, terms=terms)


def policy_env(name: str, store: Store) -> str | None:
    """The task that the policy `name` was trained for; None if it is not recorded."""
    if name == RANDOM or is_foreign(name):
        return None
    run = find_run(name, store)
    return read_policy(Path(name)).env if run is None else run.env


def load_policy(name: str, store: Store, known: Task, step: int | None = None) -> PolicyOfInterest:
    """The policy `name`, which is one of POLICIES. Raises UserError.

    `step` selects the policy that a run had at the model fit of that env step.
    """
    if name == RANDOM:
        return UniformPolicy(known.obs_dim, known.action_dim)
    if is_foreign(name):
        _no_step(name, step)
        # A task may scale its observations by their bounds.
        own_obs = known.own_obs if isinstance(known, GymnasiumTask) else np.asarray
        return foreign_policy(name, known.obs_dim, action_bounds(known), own_obs)
    policy = _stored(name, store, step)
    dims = policy.obs_dim, policy.action_dim
    if dims != (known.obs_dim, known.action_dim):
        raise UserError(
            f"policy {name} maps {dims[0]} observations to {dims[1]} actions, {known.name} has "
            f"{known.obs_dim} and {known.action_dim}: name a policy of that task"
        )
    if policy.env != known.name:  # dimensions alone do not tell Walker2d from HalfCheetah
        raise UserError(
            f"policy {name} is of {policy.env}, not of {known.name}: name a policy of {known.name}"
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
    per seed. Raises UserError if a learner needs something that the policy lacks.
    """
    for name in learners:
        if name not in LEARNERS:
            raise unknown("learner", name, LEARNERS)
        if follows_value(name) and policy.value_gradient is None:
            raise UserError(
                f"learner {name} follows a value function, and this policy comes without one: "
                f"leave {name} out, or name the policy of a newer run"
            )
    for seed in seeds:
        made, fresh = (
            made_anew(known, policy, footprint_rows, seed, use, stepped)
            for use in ("footprint", "fresh episodes")
        )
        for name in learners:
            yield _weigh(data, policy, made, fresh, config.but(learner=name, seed=seed))


def made_anew(
    known: Task,
    policy: PolicyOfInterest,
    rows: int,
    seed: int,
    use: str = "footprint",
    stepped: Callable[[], None] = lambda: None,
) -> Footprint:
    """Transitions of the policy in the real environment, reproducible for each seed and `use`."""
    streams = Streams(seed)
    start, draws = streams.integer(f"{use} env"), streams.torch(use)
    return footprint(known, policy, rows, start, draws, stepped)


def _weigh(
    data: OrderedData,
    policy: PolicyOfInterest,
    made: Footprint,
    fresh: Footprint,
    config: RunConfig,
) -> Weighed:
    rows, streams = data.transitions, Streams(config.seed)
    dims = rows.obs.shape[1], rows.action.shape[1]
    learner = make_learner(config.learner, config, *dims, streams.torch("learner"))
    context = FitContext(
        replay=rows,
        policy_version=data.policy_version,
        policy_buffer=made.transitions.torch(),
        on_policy_steps=max(len(made.transitions), config.tom.warmup),
        initial_obs=data.initial_obs,
        policy=policy,
        generator=streams.torch("weigh"),
        value_gradient=policy.value_gradient,
    )
    weighting = learner.weigh(context)
    judges, generator = fresh.transitions.torch(), streams.torch("exam")
    match = footprint_match(rows, weighting.weights, judges, step_scaling(rows), generator)
    ratio = None if weighting.log_ratio is None else weighting.log_ratio.to(torch.float32).numpy()
    terms = {} if weighting.terms is None else weighting.terms.recorded()
    return Weighed(
        learner=config.learner,
        seed=config.seed,
        weights=weighting.weights.to(torch.float32).numpy(),
        log_ratio=ratio,
        metrics=dict(weighting.metrics),
        notices=tuple(weighting.notices),
        footprint_return=float(np.mean(made.returns)) if made.returns else None,
        match=match,
        terms={name: term.to(torch.float32).numpy() for name, term in terms.items()},
    )


def _stored(name: str, store: Store, step: int | None) -> StoredPolicy:
    run = find_run(name, store)
    if run is None:
        _no_step(name, step)
        return read_policy(Path(name))
    if run.has_policy(step):
        return read_policy(run.path / (NAME if step is None else layout.policy(step)))
    of = "its end" if step is None else f"step {step}"
    raise UserError(f"run {run.run_id} kept no policy of {of}: {_advice(run, step)}")


def _advice(run: RunReader, step: int | None) -> str:
    """What to do where a run has no policy of `step` (None: of its end)."""
    if run.fits_model and (kept := run.policy_steps()):
        return "--step takes one of " + ", ".join(map(str, kept))
    if step is not None and run.has_policy():
        return "it kept none of its fits (nor did any run of an earlier version): omit --step"
    if run.status.state == "finished":
        return "name another run"
    return "train it to its end, or name another run"


def _no_step(name: str, step: int | None) -> None:
    if step is not None:
        raise UserError(f"--step {step} is a step of a run, and policy {name} is none: name a run")


OWN, EXACT = "own", "exact"
PRESETS = (OWN, EXACT, "paper", "mended", "released")
"""the run's own settings, TOM's `exact` ones, or the learners' of a training's preset"""


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

    @property
    def steps(self) -> int:
        """The number of steps that the policy will take in the real environment."""
        return 2 * self.footprint * len(self.seeds)

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
    random: str | None = None,
    preset: str | None = None,
    settings: Mapping[str, Any],
) -> WeighingPlan:
    """The plan to weigh `data` for `policy`; `tom weigh` documents both.

    `settings` are nested like `RunConfig` and override the preset. Raises UserError, or pydantic's
    ValidationError for a wrong setting.
    """
    if footprint < 1:
        raise UserError(f"a footprint of {footprint} steps is none: it takes at least 1")
    rows, name = _data(data, policy, store, env, step, random)
    known = task(name)
    preset = preset or (EXACT if step is None else OWN)
    usual = _config(preset, data, store, name)
    config = usual.but(**settings)
    before, now = (in_words(one.model_dump(include=setting_groups())) for one in (usual, config))
    for seed in seeds:
        config.but(seed=seed)
    for learner in learners:
        if learner not in LEARNERS:
            raise unknown("learner", learner, LEARNERS)
    return WeighingPlan(
        rows, known, load_policy(policy, store, known, step), config, preset,
        tuple(dict.fromkeys(learners)), tuple(dict.fromkeys(seeds)), footprint,
        {path: value for path, value in now.items() if before.get(path) != value},
    )  # fmt: skip


def _data(
    name: str, policy: str, store: Store, env: str | None, step: int | None, random: str | None
) -> tuple[OrderedData, str]:
    env = env or policy_env(policy, store)
    data = load_data(name, store, env, step)
    if data.env != (env or data.env):
        raise UserError(f"{data.name} is of {data.env}, not of {env}: name a policy of {data.env}")
    if random:
        data = after_random(load_data(random, store, data.env), data)
    assert data.env is not None
    return data, data.env


def _config(preset: str, data: str, store: Store, env: str) -> RunConfig:
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    if preset == OWN:
        return _own_settings(data, store)
    if preset == EXACT:
        return settings_type()(env=env, learner="tom", tom=TomConfig.preset(EXACT))
    return _learners_settings(presets.resolve(env, "tom", preset))


def _own_settings(name: str, store: Store) -> RunConfig:
    run = find_run(name, store)
    if run is None:
        raise UserError(f"{name} is no run, so it has no settings: --preset exact, paper or mended")
    return _learners_settings(recorded_config(run, "name --preset exact, paper or mended"))


def _learners_settings(of: RunConfig) -> RunConfig:
    """The settings of every learner that a training's configuration has."""
    own = {group: getattr(of, group) for group in setting_groups() if hasattr(of, group)}
    return settings_type()(env=of.env, learner="tom", **own)


def settings_type() -> type[RunConfig]:
    """The configuration class with the settings of every plug-in's learner."""
    return with_own_settings(RunConfig, LEARNERS)


def setting_groups() -> set[str]:
    """The names of the groups of learners' settings."""
    return {entry.group for entry in LEARNERS.values() if entry.group}
