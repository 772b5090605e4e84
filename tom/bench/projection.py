"""Projected time of whole trainings on one core and size of their files, from Hopper's parts.

The last `tom bench` of this kind of machine is kept: `tom sweep --dry-run` projects hours from it.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from math import isfinite
from statistics import fmean
from typing import Any

from tom.bench.timing import DISTANCES, EXAM, model_flops, rollout_flops, sac_flops
from tom.config import ModelConfig, OnlineConfig, SacConfig, TomConfig
from tom.envs import ENVS, Task, task
from tom.learners import SUBJECT
from tom.machine.matmul import cache_file
from tom.record.files import replace
from tom.sweep.projection import Cost, steps_to_train
from tom.training.plan import Trial
from tom.training.presets import resolve

PRESETS = ("paper", "mbpo")
NEEDED = (
    *("SAC update", "mdn step (in a fit)", "ensemble step (in a fit)", "dual Q step"),
    *("discriminator step", "weights, 1000 transitions", "rollout, 1000 states", "Hopper-v5 step"),
)
"""the parts of `tom bench` that a projection needs"""
EPISODE = 1000  # maximum length of an episode in every task


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


def written_bytes(config: OnlineConfig, task: Task) -> float:
    """Upper bound in bytes of a run folder without recording: episodes never end early.

    The replay buffer, two checkpoints (modelled transitions, networks, Adam's moments), the
    evaluations, and the policies and weights that some fits store.
    """
    row = 2 * task.obs_dim + task.action_dim + 2
    last = config.rollout.kept_at(config.steps - config.exploration_steps, config.fit_every)
    evaluations = config.steps / config.evaluation.every * config.evaluation.episodes
    frame = task.obs_dim + task.action_dim + 2 * task.nq + 1
    network = _numbers(config.sac.hidden, config.sac.layers, task)  # actor, critic, Q and the like
    members = 1 if config.model.kind == "mdn" else config.model.members
    model = members * _numbers(config.model.hidden, config.model.layers, task)
    kept = config.snapshots * (3 * network + config.steps / 2)  # actor and critics, weights
    checkpoint = last * row + 3 * model + 17 * network  # SAC 3 x 3 + 2 targets, TOM's two x 3
    return 4.0 * (config.steps * row + 2 * checkpoint + evaluations * EPISODE * frame + kept)


def save_bench(ms: Mapping[str, float]) -> None:
    """Store CPU milliseconds by part in the user's cache, if it can be written."""
    path = cache_file("bench")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace(path, lambda file: file.write(json.dumps(dict(ms)).encode()), sync=False)


def last_bench() -> dict[str, float] | None:
    """The last stored result; None if there is none, or it is damaged or incomplete."""
    try:
        content = json.loads(cache_file("bench").read_text())
        ms = {name: float(content[name]) for name in NEEDED}
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return ms if all(isfinite(value) and value > 0 for value in ms.values()) else None


def bench_cost(trial: Trial, ms: Mapping[str, float], done: int = 0) -> Cost | None:
    """The remaining cost of a training on one core of this machine, from step `done` on.

    None for road-and-rocks and for a GPU, which `tom bench` does not measure.
    """
    config = trial.config
    if not isinstance(config, OnlineConfig) or config.device != "cpu":
        return None
    known = task(trial.env)
    hours = per_step_ms(config, known, ms) * steps_to_train(trial, done) / 3.6e6
    rest = max(config.total_steps - done, 0) / config.total_steps
    return Cost(hours, written_bytes(config, known) * rest / 1e6, "tom bench, at most")


def _numbers(hidden: int, layers: int, task: Task) -> int:
    """Approximate number of parameters of a network over (s, a)."""
    return hidden * (task.obs_dim + task.action_dim + hidden * (layers - 1))
