"""What runs were trained with beside their preset: whether they may be held against each other."""

from collections.abc import Sequence
from typing import Any

from tom.config import flat
from tom.record import RunReader
from tom.training.presets import resolve

OWN = ("seed", "steps")
"""settings in which runs that are compared may differ"""


def changed(run: RunReader) -> dict[str, Any]:
    """The settings, by dotted path, in which a run differs from its preset for its learner."""
    has = flat(run.config["config"])
    preset = resolve(run.env, run.learner, run.config["preset"]).model_dump(mode="json")
    usual = flat(preset)
    paths = [path for path in sorted(has.keys() | usual.keys()) if path not in OWN]
    return {path: has.get(path) for path in paths if has.get(path) != usual.get(path)}


def unlike(runs: Sequence[RunReader]) -> list[str]:
    """Paths of the settings that some of these runs have changed and others not, or not alike."""
    found = [changed(run) for run in runs]
    paths = sorted({path for one in found for path in one})
    return [
        path
        for path in paths
        if len({repr(one[path]) if path in one else "as the preset" for one in found}) > 1
    ]
