"""Fair timing on a shared machine: CPU time, interleaved repeats, medians and their spread.

Target costs of the parts are ratios or shares in one run, or ms on the reference machine.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from time import process_time

import torch

from tom.config import ModelConfig, SacConfig
from tom.machine.matmul import Backend, use

OBS, ACTION, BATCH = 11, 3, 256  # of Hopper

TIMES_FLOOR = {"SAC update": 1.7}
TIMES_OURS = {
    "plain torch.distributions MDN step": 1.7,
    "stable-baselines3 SAC update": 2.5,
}
MILLISECONDS = {"weights, 1000 transitions": 4.0, "rollout, 1000 states": 3.0}
"""4 s for 1e6 transitions, 0.3 s for 100 000 states"""
EXAM = "exam of 250 steps"
DISTANCES = "weights by policy distance, 40 000 rows"
PERCENT = {EXAM: (1.0, "training"), DISTANCES: (1.0, "TOM's weights and these")}
"""of the time from one fit of a training to the next, or of TOM's weights, this part included"""


@dataclass(frozen=True)
class Part:
    """A part to time: `run` does it `units` times.

    `flops` counts the matrix products of one unit, if they are its floor. A peer is another
    library's version of the part `peer_of`; it runs with torch's default matrix products.
    """

    name: str
    run: Callable[[], object]
    units: int = 1
    flops: float | None = None
    peer_of: str | None = None


@dataclass(frozen=True)
class Timing:
    """One part's cost: CPU milliseconds per unit, spread, floor and ratio to the floor."""

    part: str
    ms: float
    low_ms: float
    high_ms: float
    floor_ms: float | None
    times_floor: float | None
    times_ours: float | None


def measure(parts: Sequence[Part], repeats: int, backend: Backend) -> tuple[list[Timing], float]:
    """Time all parts in turn, repeatedly; also return the machine's GFLOP/s in that time.

    The machine's speed is that of a 256^3 product of the chosen backend, measured among the
    parts, so that the ratios stay right when the machine's speed drifts.
    """
    a, b = torch.randn(256, 256), torch.randn(256, 256)
    product = Part("256^3 product", lambda: [a @ b for _ in range(100)], units=100)
    seconds: dict[str, list[float]] = {p.name: [] for p in (product, *parts)}
    for repeat in range(repeats + 1):
        for part in (product, *parts):
            use("default" if part.peer_of else backend)
            start = process_time()
            part.run()
            if repeat:  # the first repeat only warms up allocators and kernels
                seconds[part.name].append((process_time() - start) / part.units)
    use(backend)
    middle = {name: median(took) for name, took in seconds.items()}
    flops_per_s, rows = 2 * 256**3 / middle[product.name], []
    for part in parts:
        took, floor = middle[part.name], part.flops and part.flops / flops_per_s
        rows.append(
            Timing(
                part=part.name,
                ms=took * 1e3,
                low_ms=min(seconds[part.name]) * 1e3,
                high_ms=max(seconds[part.name]) * 1e3,
                floor_ms=floor and floor * 1e3,
                times_floor=floor and took / floor,
                times_ours=took / middle[part.peer_of] if part.peer_of else None,
            )
        )
    return rows, flops_per_s / 1e9


def target(row: Timing, beside_ms: Mapping[str, float]) -> tuple[str, bool] | None:
    """A part's target as text and whether it is met; None if it has no target.

    `beside_ms` is what the parts of PERCENT are a share of, less the part itself
    (`projection.beside_ms`).
    """
    if (bound := TIMES_FLOOR.get(row.part)) and row.times_floor is not None:
        return f"<= {bound} x floor", row.times_floor <= bound
    if (bound := TIMES_OURS.get(row.part)) and row.times_ours is not None:
        return f">= {bound} x ours", row.times_ours >= bound
    if bound := MILLISECONDS.get(row.part):
        beyond = row.floor_ms is not None and row.floor_ms > bound
        here = f", under this machine's floor of {row.floor_ms:.2g}" if beyond else ""
        return f"<= {bound} ms{here}", row.ms <= bound
    if row.part in PERCENT:
        bound, whole = PERCENT[row.part]
        percent = 100 * row.ms / (row.ms + beside_ms[row.part])
        return f"<= {bound:.0f} % of {whole}, here {percent:.2g} %", percent <= bound
    return None


# Matrix arithmetic


def network_flops(sizes: list[int], rows: int) -> float:
    """Multiply-adds of one forward pass, times two."""
    return 2.0 * rows * sum(a * b for a, b in pairwise(sizes))


def model_flops(config: ModelConfig, obs: int = OBS, action: int = ACTION) -> float:
    """Matrix arithmetic of a step of the mixture density network's fit, or the ensemble's."""
    per_dim, networks = {"mdn": (3 * config.components, 1), "ensemble": (2, config.members)}[
        config.kind
    ]
    sizes = [obs + action, *[config.hidden] * config.layers, (1 + obs) * per_dim]
    forward, first = network_flops(sizes, BATCH), network_flops(sizes[:2], BATCH)
    return networks * (3 * forward - first)


def sac_flops(config: SacConfig, obs: int = OBS, action: int = ACTION) -> float:
    """Matrix arithmetic of a SAC update.

    Critics: target forward, forward, and two backward products a layer but for the first layer's
    input; actor: forward at s and s', backward, and the critics' forward and input gradient.
    """
    hidden = [config.hidden] * config.layers
    critic = network_flops([obs + action, *hidden, 1], BATCH)
    critic_first = network_flops([obs + action, config.hidden], BATCH)
    actor = network_flops([obs, *hidden, 2 * action], BATCH)
    actor_first = network_flops([obs, config.hidden], BATCH)
    critics = 2 * (critic + critic + 2 * critic - critic_first)
    return critics + 2 * actor + (2 * actor - actor_first) + 2 * (critic + critic)


def rollout_flops(
    model: ModelConfig, sac: SacConfig, obs: int = OBS, action: int = ACTION
) -> float:
    """Matrix arithmetic of one rollout step: the actor, then the mixture density network."""
    outputs = (1 + obs) * 3 * model.components
    return network_flops([obs, *[sac.hidden] * sac.layers, 2 * action], 1) + network_flops(
        [obs + action, *[model.hidden] * model.layers, outputs], 1
    )
