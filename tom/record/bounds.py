"""How much a file of a run can hold, by the run's settings."""

from collections.abc import Mapping
from typing import Any

from tom.data.unpack import MOST
from tom.machine.memory import available

ROW_BYTES = 16_000
"""More than a step of any task takes: Humanoid's, its simulator's state too, is 6 kB in doubles."""

EPISODE_ROWS = 1000
"""steps at most of an evaluation's episode"""


def most_bytes(config: Mapping[str, Any]) -> int:
    """Bytes that no file of arrays of the run unpacks to; `config` is its `config.json`.

    Rows for every step (two for one of SAC's) and for an evaluation's episodes, and its networks;
    never more than this machine has free.
    """
    rows = 2 * _count(config, "steps") + EPISODE_ROWS * _count(config, "evaluation", "episodes")
    hidden, layers = _count(config, "sac", "hidden"), _count(config, "sac", "layers")
    return min(MOST + ROW_BYTES * rows + 32 * hidden**2 * layers, available())


def _count(config: Mapping[str, Any], *path: str) -> int:
    """The whole number at `path` of the settings; 0 where there is none."""
    value: Any = config.get("config")
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return max(value, 0) if isinstance(value, int) else 0
