"""How long whole trainings take on one core, from what the parts cost on Hopper."""

from collections.abc import Mapping
from typing import Any

from tom.bench.parts import model_flops, rollout_flops, sac_flops
from tom.config import ModelConfig, OnlineConfig, RolloutConfig, SacConfig
from tom.envs import ENVS, MujocoTask
from tom.presets import resolve

PRESETS = ("paper", "mbpo")


def hours(ms: Mapping[str, float]) -> list[dict[str, Any]]:
    """At most so many hours for TOM in each environment and preset, to its number of steps.

    `ms` is CPU milliseconds by part. Networks of other sizes are scaled by their arithmetic; every
    fit is counted as if it used all its rounds; evaluation and recording are left out.
    """
    rows = []
    for name, task in ENVS.items():
        row: dict[str, Any] = {"env": name, "steps": task.steps}
        for preset in PRESETS:
            config = resolve(name, "tom", preset)
            assert isinstance(config, OnlineConfig)
            row[f"{preset}_h"] = per_step_ms(config, task, ms) * task.steps / 3.6e6
        rows.append(row)
    return rows


def per_step_ms(config: OnlineConfig, task: MujocoTask, ms: Mapping[str, float]) -> float:
    """CPU milliseconds of one env step, the fits' share in it."""
    dims = task.obs_dim, task.action_dim
    sac = ms["SAC update"] * sac_flops(config.sac, *dims) / sac_flops(SacConfig())
    kind = ModelConfig.model_validate({"kind": config.model.kind})
    part = f"{config.model.kind} step (in a fit)"
    model = ms[part] * model_flops(config.model, *dims) / model_flops(kind)
    rolled = rollout_flops(config.model, config.sac, *dims) / rollout_flops(kind, SacConfig())
    fit = config.model.rounds * config.model.batches_per_round * model
    fit += config.tom.q_steps * ms["dual Q step"]
    fit += config.tom.discriminator_steps * ms["discriminator step"]
    fit += ms["weights, 1000 transitions"] * task.steps / 2 / 1000  # the buffer's mean size
    fit += ms["rollout, 1000 states"] * rolled * _starts(config.rollout, task.steps) / 1000
    return config.updates_per_step * sac + fit / config.fit_every + ms["Hopper-v5 step"]


def _starts(rollout: RolloutConfig, steps: int) -> float:
    """Rollout steps of a fit, at the mean length over a training of so many env steps."""
    lengths = [rollout.length_at(at) for at in range(0, steps, max(steps // 100, 1))]
    return rollout.starts * sum(lengths) / len(lengths)
