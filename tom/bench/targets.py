"""Target costs of the parts: ratios or shares in one run, or ms on the reference machine."""

from tom.bench.parts import EXAM
from tom.bench.timing import Timing

TIMES_FLOOR = {"SAC update": 1.7}
TIMES_OURS = {
    "plain torch.distributions MDN step": 1.7,
    "stable-baselines3 SAC update": 2.5,
    "mbrl-lib SAC update": 2.5,
}
MILLISECONDS = {"weights, 1000 transitions": 4.0, "rollout, 1000 states": 3.0}
"""4 s for 1e6 transitions, 0.3 s for 100 000 states"""
PERCENT = {EXAM: 1.0}
"""of the time from one fit of a training to the next, this part included"""


def target(row: Timing, between_ms: float) -> tuple[str, bool] | None:
    """A part's target in words and whether it is met; None if it has no target.

    `between_ms` is the time of a training from one fit to the next (`projection.between_fits_ms`).
    """
    if row.part in TIMES_FLOOR and row.times_floor is not None:
        bound = TIMES_FLOOR[row.part]
        return f"<= {bound} x floor", row.times_floor <= bound
    if row.part in TIMES_OURS and row.times_ours is not None:
        bound = TIMES_OURS[row.part]
        return f">= {bound} x ours", row.times_ours >= bound
    if row.part in MILLISECONDS:
        bound = MILLISECONDS[row.part]
        beyond = row.floor_ms is not None and row.floor_ms > bound
        here = f", under this machine's floor of {row.floor_ms:.2g}" if beyond else ""
        return f"<= {bound} ms{here}", row.ms <= bound
    if row.part in PERCENT:
        bound, percent = PERCENT[row.part], 100 * row.ms / (row.ms + between_ms)
        return f"<= {bound:.0f} % of training, here {percent:.2g} %", percent <= bound
    return None
