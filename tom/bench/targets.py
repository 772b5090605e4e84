"""Target costs of the parts: ratios in one run, or milliseconds on the reference machine."""

from tom.bench.timing import Timing

TIMES_FLOOR = {"SAC update": 1.7}
TIMES_OURS = {
    "plain torch.distributions MDN step": 1.7,
    "stable-baselines3 SAC update": 2.5,
    "mbrl-lib SAC update": 2.5,
}
MILLISECONDS = {"weights, 1000 transitions": 4.0, "rollout, 1000 states": 3.0}
"""4 s for 1e6 transitions, 0.3 s for 100 000 states"""


def target(row: Timing) -> tuple[str, bool] | None:
    """A part's target in words and whether it is met; None if it has no target."""
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
    return None
