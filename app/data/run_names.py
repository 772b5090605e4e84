"""The names of runs that are shown together."""

from collections import Counter
from collections.abc import Sequence

from tom.analysis.settings import distinguishing_presets, variants
from tom.learners import learner_label
from tom.readable import task_title
from tom.record.reader import RunReader


def distinct_names(runs: Sequence[RunReader], *, by_user: bool = False) -> dict[str, str]:
    """`TOM s0` for each run id, plus a distinction from runs of the same name.

    With runs of several tasks, their task comes first: `Hopper TOM s0`. With `by_user` the user's
    name of a run replaces all that.

    The distinction is the preset if the learner has several, then the settings in which a run
    differs from the others and from its preset, then the id.
    """
    several = len({run.env for run in runs}) > 1
    return _distinct(runs, "{env} {learner} s{seed}" if several else "{learner} s{seed}", by_user)


def full_names(runs: Sequence[RunReader]) -> dict[str, str]:
    """`Hopper · TOM · seed 0`, or the user's name of the run, for each run id.

    Runs of the same name are distinguished as in `distinct_names`.
    """
    return _distinct(runs, "{env} · {learner} · seed {seed}", by_user=True)


def _distinct(runs: Sequence[RunReader], form: str, by_user: bool) -> dict[str, str]:
    """Each run's name by its id; where several share one, with their settings, else their ids."""
    names = []
    for run, preset in zip(runs, distinguishing_presets(runs), strict=True):
        learner = f"{learner_label(run.learner)} {preset}".strip()
        usual = form.format(env=task_title(run.env), learner=learner, seed=run.seed)
        names.append((by_user and run.labels.name) or usual)
    shared = Counter(names)
    variant = variants([run for run, name in zip(runs, names, strict=True) if shared[name] > 1])
    longer = [
        ", ".join(filter(None, (name, variant.get(run.run_id))))
        for run, name in zip(runs, names, strict=True)
    ]
    repeated = Counter(longer)
    return {
        run.run_id: name if repeated[name] == 1 else f"{name}, {run.run_id}"
        for run, name in zip(runs, longer, strict=True)
    }
