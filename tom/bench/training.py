"""What 250 environment steps of the paper's Hopper training cost: the measure of other costs."""

from time import process_time

from tom.config import OnlineConfig
from tom.mbpo import Mbpo
from tom.presets import resolve

CYCLE = 250  # env steps from one model fit to the next
EXPLORE = 1000


def cycle_s() -> float:
    """CPU seconds of one model fit, its rollouts and 250 env steps, before TOM starts to weigh.

    This is the cheapest part of a training: the buffer is small and there is no dual Q yet.
    """
    changes = {"exploration_steps": EXPLORE, "steps": EXPLORE + CYCLE}
    config = resolve("hopper", "tom", "paper", changes)
    assert isinstance(config, OnlineConfig)
    begun = process_time()
    for event in Mbpo(config).events():
        if event.env_step < EXPLORE:
            begun = process_time()
    return process_time() - begun
