"""The names of runs that are shown together."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Protocol

from app.theme import learner_label
from tom.analysis.settings import telling_presets
from tom.record.labels import Labels


class Named(Protocol):
    """Something with the identity of a run: a `RunInfo` or a `RunReader`."""

    @property
    def run_id(self) -> str: ...
    @property
    def env(self) -> str: ...
    @property
    def labels(self) -> Labels: ...
    @property
    def learner(self) -> str: ...
    @property
    def preset(self) -> str: ...
    @property
    def seed(self) -> int: ...


def told_apart(runs: Sequence[Named]) -> dict[str, str]:
    """`TOM s0` for each run id, plus a distinction from runs of the same name.

    The distinction is the preset if the learner has several, else the id.
    """
    presets = telling_presets(runs)
    return _apart(
        {
            run.run_id: " ".join(filter(None, (learner_label(run.learner), preset, f"s{run.seed}")))
            for run, preset in zip(runs, presets, strict=True)
        }
    )


def names(runs: Sequence[Named]) -> dict[str, str]:
    """`Hopper · TOM · seed 0`, or the user's name of the run, for each run id.

    Runs of the same name are distinguished as in `told_apart`.
    """
    presets = telling_presets(runs)
    return _apart(
        {run.run_id: run.labels.name or _name(run, p) for run, p in zip(runs, presets, strict=True)}
    )


def task(env: str) -> str:
    """A task's name for a heading: `inverted-pendulum` becomes Inverted pendulum."""
    return env if ":" in env else env.replace("-", " ").capitalize()


def _name(run: Named, preset: str) -> str:
    learner = " ".join(filter(None, (learner_label(run.learner), preset)))
    return f"{task(run.env)} · {learner} · seed {run.seed}"


def _apart(short: Mapping[str, str]) -> dict[str, str]:
    count = Counter(short.values())
    return {
        run_id: words if count[words] == 1 else f"{words}, {run_id}"
        for run_id, words in short.items()
    }
