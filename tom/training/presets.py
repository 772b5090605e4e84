"""From (env, learner, preset) to the configuration of a run: the published tables as data.

`paper` is the paper's table (appendix C.1) with the released code's schedule, `mended` the same
with TOM's objective mended and `released` with the released code's choices (docs/learners/tom.md),
`mbpo` Janner's MBPO with our fit (docs/learners/mle.md), `smoke` a small and quick run of the same
code.
An environment's values override the preset's, and the user's override both.
"""

from typing import Any

from pydantic import ValidationError

from tom.config import OnlineConfig, RoadConfig
from tom.envs import ENV_NAMES, ROAD, is_known, task, unknown_task
from tom.envs.termination import rule
from tom.errors import UserError, check_known, invalid_value
from tom.learners import LEARNERS, SUBJECT, follows_behaviour, with_own_settings

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"tom": {"action_samples": 1}},
    # The paper's numbers with TOM's objective mended: see docs/learners/tom.md.
    "mended": {
        "tom": {"flow": "stationary", "divergence": "kl", "action_samples": 4,
                "q_holdout": 0.2, "q_steps": 2000, "q_check_every": 25},
    },
    # The settings in which the authors' code differs from the paper.
    "released": {
        "tom": {"action_samples": 1, "conjugate": "released", "label_smoothing": 0.1,
                "gradient_penalty": 10.0, "discriminator_steps": 400},
        "pmac": {"decay": 0.9},
    },
    "mbpo": {
        "updates_per_step": 20,
        "model": {"kind": "ensemble", "patience": 5, "rounds": 60},
    },
    "smoke": {
        "exploration_steps": 200,
        "fit_every": 100,
        "updates_per_step": 1,
        "model": {"hidden": 32, "layers": 2, "components": 3, "members": 3, "elites": 2,
                  "rounds": 3, "batches_per_round": 20},
        "sac": {"hidden": 32, "batch_size": 64},
        "rollout": {"starts": 1000},
        "evaluation": {"every": 200, "episodes": 2},
        "tom": {"discriminator_steps": 20, "q_steps": 40, "q_hidden": 32,
                "discriminator_hidden": 32, "action_samples": 1, "warmup": 100},
    },
}  # fmt: skip

# Changes of a preset by a task. Inverted pendulum is not in the paper; it is learnt in minutes.
_PAPER: dict[str, dict[str, Any]] = {
    # -17 for actions in the task's range, +-0.4, is larger by 17 log 2.5 for actions in [-1, 1].
    "humanoid": {"model": {"hidden": 400}, "sac": {"target_entropy": -1.42}},
    "inverted-pendulum": {
        "exploration_steps": 300,
        "updates_per_step": 10,
        "model": {"hidden": 64, "layers": 3, "components": 4, "rounds": 6},
        "sac": {"hidden": 64, "lr": 1e-3},
        "rollout": {"starts": 10_000},
        "evaluation": {"every": 500, "episodes": 5},
        "tom": {"warmup": 250, "q_hidden": 64, "discriminator_hidden": 64},
    },
}

BY_ENV: dict[str, dict[str, dict[str, Any]]] = {
    "paper": _PAPER,
    "mended": _PAPER,
    "released": _PAPER,
    "mbpo": {
        "hopper": {"rollout": {"final_length": 15}, "sac": {"target_entropy": -1.0}},
        "walker2d": {"sac": {"target_entropy": -3.0}},
        "halfcheetah": {"updates_per_step": 40, "sac": {"target_entropy": -3.0}},
        "ant": {
            "rollout": {"final_length": 25, "schedule_end": 100},
            "sac": {"target_entropy": -4.0},
        },
        "humanoid": {
            "fit_every": 1000,
            "model": {"hidden": 400},
            "rollout": {"final_length": 25, "schedule_end": 300, "retain": 5},
            "sac": {"target_entropy": -2.0},
        },
    },
}

# All presets of road-and-rocks but this one are the paper's.
OF_ROAD: dict[str, dict[str, Any]] = {
    "smoke": {
        "steps": 600,
        "fit_every": 300,
        "evaluation": {"every": 150, "episodes": 5},
        "sac": {"hidden": 64},
        "tom": {"discriminator_steps": 300, "q_steps": 500, "q_hidden": 64,
                "discriminator_hidden": 64, "action_samples": 4},
    },
}  # fmt: skip


def resolve(
    env: str, learner: str, preset: str | None = None, overrides: dict[str, Any] | None = None
) -> OnlineConfig | RoadConfig:
    """The frozen configuration of a run; without a preset that of `default_preset`.

    Raises UserError for an unknown environment, learner, preset or rule; pydantic's ValidationError
    for an unknown or impossible value among `overrides` (nested dicts of field values).
    """
    if not is_known(env):
        raise unknown_task(env, ENV_NAMES)
    check_known("learner", [learner], learners(env))
    preset = preset or default_preset(env, learner)
    check_known("preset", [preset], PRESETS)
    if env == ROAD:
        config = RoadConfig(learner=learner).but(**OF_ROAD.get(preset, {}))
    else:
        known = task(env)  # raises UserError for an unknown task, before anything is written
        steps = 600 if preset == "smoke" else known.steps
        config = OnlineConfig(env=env, learner=learner, steps=steps).but(**PRESETS[preset])
        try:
            if preset != "smoke":
                config = config.but(**BY_ENV[preset].get(env, {})).but(**known.settings)
        except ValidationError as error:
            raise UserError(f"task {env}: its setting {invalid_value(error)}") from None
        config = config.but(**LEARNERS[learner].settings)
    config = config_type(env, learner).model_validate(config.model_dump())
    # A plug-in's settings are only in the runs of its learner.
    others = {entry.group for name, entry in LEARNERS.items() if entry.own and name != learner}
    given = {name: value for name, value in (overrides or {}).items() if name not in others}
    config = config.but(env=env, learner=learner, preset=preset, **given)
    if isinstance(config, OnlineConfig) and config.model.termination is not None:
        rule(task(env), config.model.termination)
    return config


def default_preset(env: str, learner: str) -> str:
    """The preset of a training that names none: TOM's objective is the mended one.

    On road-and-rocks all presets but `smoke` are the paper's.
    """
    return "mended" if learner == SUBJECT and env != ROAD else "paper"


def learners(env: str) -> tuple[str, ...]:
    """The learners of an environment; road-and-rocks also has the baselines of its study.

    Its data does not say which policies drew the actions.
    """
    if env != ROAD:
        return tuple(LEARNERS)
    from tom.road.baselines import BASELINES  # here: it imports torch

    return (*(name for name in LEARNERS if not follows_behaviour(name)), *BASELINES)


def config_type(env: str, *learners: str) -> type[OnlineConfig | RoadConfig]:
    """The configuration class of an environment's runs, with these learners' own settings."""
    base = RoadConfig if env == ROAD else OnlineConfig
    return with_own_settings(base, learners)
