"""Projected time of whole trainings on one core, from Hopper's parts."""

from collections.abc import Mapping
from statistics import fmean
from typing import Any

from tom.bench.timing import DISTANCES, EXAM, model_flops, rollout_flops, sac_flops
from tom.config import ModelConfig, OnlineConfig, SacConfig, TomConfig
from tom.envs import ENVS, Task, task
from tom.learners import SUBJECT
from tom.training.presets import resolve

PRESETS = ("paper", "mbpo")


def hours(ms: Mapping[str, float]) -> list[dict[str, Any]]:
    """Upper bounds in hours for TOM in each environment and preset, for its number of steps.

    `ms` is CPU milliseconds by part. Networks of other sizes are scaled by their arithmetic; every
    fit counts as if it used all its rounds; evaluation and recording are not included.
    """
    rows = []
    for name, known in ENVS.items():
        row: dict[str, Any] = {"env": name, "steps": known.steps}
        for preset in PRESETS:
            config = resolve(name, SUBJECT, preset)
            assert isinstance(config, OnlineConfig)
            row[f"{preset}_h"] = per_step_ms(config, known, ms) * known.steps / 3.6e6
        rows.append(row)
    return rows


def per_step_ms(config: OnlineConfig, task: Task, ms: Mapping[str, float]) -> float:
    """CPU milliseconds of one env step, including its share of the fits.

    Of the learners only TOM's work is counted, because only TOM is measured.
    """
    dims = task.obs_dim, task.action_dim
    sac = ms["SAC update"] * sac_flops(config.sac, *dims) / sac_flops(SacConfig())
    # Mean-only networks have half the outputs of the ensemble and are not measured separately.
    timed = "mdn" if config.model.kind == "mdn" else "ensemble"
    own, kind = config.model.but(kind=timed), ModelConfig(kind=timed)
    model = ms[f"{timed} step (in a fit)"] * model_flops(own, *dims) / model_flops(kind)
    rolled = rollout_flops(own, config.sac, *dims) / rollout_flops(kind, SacConfig())
    fit = config.model.rounds * config.model.batches_per_round * model
    if config.learner == SUBJECT:
        fit += weighing_ms(config.tom, config.steps / 2, ms)  # the buffer's mean size
    every = max(config.steps // 100, 1)
    length = fmean(config.rollout.length_at(at) for at in range(0, config.steps, every))
    fit += ms["rollout, 1000 states"] * rolled * config.rollout.starts * length / 1000
    return config.updates_per_step * sac + fit / config.fit_every + ms["Hopper-v5 step"]


def weighing_ms(config: TomConfig, rows: float, ms: Mapping[str, float]) -> float:
    """CPU milliseconds of TOM's weights for a buffer of `rows`."""
    trained = config.q_steps * ms["dual Q step"]
    trained += config.discriminator_steps * ms["discriminator step"]
    return trained + ms["weights, 1000 transitions"] * rows / 1000


def beside_ms(ms: Mapping[str, float]) -> dict[str, float]:
    """What the parts of `tom.bench.timing.PERCENT` are a share of, in CPU milliseconds."""
    tom = resolve("hopper", SUBJECT, "paper").tom
    return {EXAM: between_fits_ms(ms), DISTANCES: weighing_ms(tom, 40_000, ms)}


def between_fits_ms(ms: Mapping[str, float]) -> float:
    """CPU milliseconds from a fit of TOM's default training on Hopper to the next, less the exam.

    Unlike in `hours` the fit has the fewest rounds that it can have: the first, and then as many
    without a gain as end it.
    """
    config = resolve("hopper", SUBJECT)
    assert isinstance(config, OnlineConfig)
    shortest = config.but(model={"rounds": config.model.patience + 2})
    return shortest.fit_every * per_step_ms(shortest, task("hopper"), ms)
