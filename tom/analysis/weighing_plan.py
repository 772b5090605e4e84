"""The data, policy and settings of a weighing, checked before anything is computed."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tom.analysis.ordered_data import OrderedData, after_random, find_run, load_data
from tom.analysis.weighing import PolicyOfInterest, Weighed, load_policy, policy_env, weigh
from tom.config import RunConfig, TomConfig, in_words
from tom.envs import Task, task
from tom.errors import UserError, unknown
from tom.learners import LEARNERS, with_own_settings
from tom.record import Store
from tom.training import presets
from tom.training.resume import recorded_config

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
