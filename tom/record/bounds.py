"""Upper bounds on the size of a run's files, from the run's settings."""

from collections.abc import Mapping
from typing import Any

from tom.data.unpack import MOST
from tom.machine.memory import available

ROW_BYTES = 16_000
"""bytes above those of a step in any task: Humanoid's with simulator state is 6 kB in doubles"""

EPISODE_ROWS = 1000
"""maximum number of steps of an evaluation's episode"""


def most_bytes(config: Mapping[str, Any]) -> int:
    """Upper bound in bytes of an unpacked array file of the run; `config` is its `config.json`.

    It counts rows for every step (two in a recording of SAC) and for an evaluation's episodes, and
    the networks, but is never more than this machine's free memory.
    """
    rows = 2 * _count(config, "steps") + EPISODE_ROWS * _count(config, "evaluation", "episodes")
    hidden, layers = _count(config, "sac", "hidden"), _count(config, "sac", "layers")
    return min(MOST + ROW_BYTES * rows + 32 * hidden**2 * layers, available())


def _count(config: Mapping[str, Any], *path: str) -> int:
    """The integer at `path` of the settings; 0 if there is none."""
    value: Any = config.get("config")
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return max(value, 0) if isinstance(value, int) else 0
