"""The names of runs that are shown together."""

from collections import Counter
from collections.abc import Sequence

from app.theme import learner_label
from tom.analysis.settings import telling_presets, variants
from tom.record.reader import RunReader


def told_apart(runs: Sequence[RunReader]) -> dict[str, str]:
    """`TOM s0` for each run id, plus a distinction from runs of the same name.

    With runs of several tasks, their task comes first: `Hopper TOM s0`.

    The distinction is the preset if the learner has several, then the settings in which a run
    differs from the others and from its preset, then the id.
    """
    return _apart(runs, _short(runs))


def short_names(runs: Sequence[RunReader]) -> dict[str, str]:
    """As `told_apart`, but the user's name of a run that has one."""
    short = zip(runs, _short(runs), strict=True)
    return _apart(runs, [run.labels.name or name for run, name in short])


def names(runs: Sequence[RunReader]) -> dict[str, str]:
    """`Hopper · TOM · seed 0`, or the user's name of the run, for each run id.

    Runs of the same name are distinguished as in `told_apart`.
    """
    called = [
        run.labels.name or f"{task(run.env)} · {_learner(run, preset)} · seed {run.seed}"
        for run, preset in zip(runs, telling_presets(runs), strict=True)
    ]
    return _apart(runs, called)


def task(env: str) -> str:
    """A task's name for a heading: `inverted-pendulum` becomes Inverted pendulum."""
    if ":" in env:
        return env
    return "HalfCheetah" if env == "halfcheetah" else env.replace("-", " ").capitalize()


def _short(runs: Sequence[RunReader]) -> list[str]:
    several = len({run.env for run in runs}) > 1
    return [
        f"{task(run.env)} {_learner(run, preset)} s{run.seed}"
        if several
        else f"{_learner(run, preset)} s{run.seed}"
        for run, preset in zip(runs, telling_presets(runs), strict=True)
    ]


def _learner(run: RunReader, preset: str) -> str:
    return " ".join(filter(None, (learner_label(run.learner), preset)))


def _apart(runs: Sequence[RunReader], short: Sequence[str]) -> dict[str, str]:
    """Each run's name by its id; where several share one, with their settings, else their ids."""
    shared = Counter(short)
    variant = variants([run for run, name in zip(runs, short, strict=True) if shared[name] > 1])
    longer = [
        ", ".join(filter(None, (name, variant.get(run.run_id))))
        for run, name in zip(runs, short, strict=True)
    ]
    still = Counter(longer)
    return {
        run.run_id: name if still[name] == 1 else f"{name}, {run.run_id}"
        for run, name in zip(runs, longer, strict=True)
    }
