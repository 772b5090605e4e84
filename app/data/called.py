"""The names of runs that are shown together."""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from app.theme import learner_label
from tom.analysis.settings import telling_presets, variants
from tom.config import Settings
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
    @property
    def settings(self) -> Settings: ...


def told_apart(runs: Sequence[Named]) -> dict[str, str]:
    """`TOM s0` for each run id, plus a distinction from runs of the same name.

    With runs of several tasks, their task comes first: `Hopper TOM s0`.

    The distinction is the preset if the learner has several, then the settings in which a run
    differs from the others and from its preset, then the id.
    """
    return _apart(runs, _short(runs))


def short_names(runs: Sequence[Named]) -> dict[str, str]:
    """As `told_apart`, but the user's name of a run that has one."""
    short = zip(runs, _short(runs), strict=True)
    return _apart(runs, [run.labels.name or name for run, name in short])


def names(runs: Sequence[Named]) -> dict[str, str]:
    """`Hopper · TOM · seed 0`, or the user's name of the run, for each run id.

    Runs of the same name are distinguished as in `told_apart`.
    """
    presets = telling_presets(runs)
    return _apart(
        runs, [run.labels.name or _name(run, p) for run, p in zip(runs, presets, strict=True)]
    )


def task(env: str) -> str:
    """A task's name for a heading: `inverted-pendulum` becomes Inverted pendulum."""
    if ":" in env:
        return env
    return "HalfCheetah" if env == "halfcheetah" else env.replace("-", " ").capitalize()


def _short(runs: Sequence[Named]) -> list[str]:
    several = len({run.env for run in runs}) > 1
    names = []
    for run, preset in zip(runs, telling_presets(runs), strict=True):
        parts = task(run.env) if several else "", learner_label(run.learner), preset
        names.append(" ".join([*filter(None, parts), f"s{run.seed}"]))
    return names


def _name(run: Named, preset: str) -> str:
    learner = " ".join(filter(None, (learner_label(run.learner), preset)))
    return f"{task(run.env)} · {learner} · seed {run.seed}"


def _apart(runs: Sequence[Named], short: Sequence[str]) -> dict[str, str]:
    """Each run's name by its id; where several share one, with their settings, else their ids."""
    shared = Counter(short)
    alike = [run for run, name in zip(runs, short, strict=True) if shared[name] > 1]
    variant = variants(alike) if alike else {}
    longer = [
        ", ".join(filter(None, (name, variant.get(run.run_id))))
        for run, name in zip(runs, short, strict=True)
    ]
    still = Counter(longer)
    return {
        run.run_id: name if still[name] == 1 else f"{name}, {run.run_id}"
        for run, name in zip(runs, longer, strict=True)
    }
