"""The settings that runs were made with: what differs, and what puts runs into one group."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import pandas as pd

from tom.config import flat
from tom.learners import others_groups

Settings = Mapping[str, str]

# They change nothing in a run's numbers, or not those that two runs of another length share.
NO_MATTER = {"seed", "steps", "checkpoint_every", "snapshots", "bins", "threads"}
NO_MATTER |= {"device", "matmul", "env", "learner", "preset"}
NONE = "-"


class Made(Protocol):
    """A run, as far as its settings go."""

    @property
    def run_id(self) -> str: ...
    @property
    def env(self) -> str: ...
    @property
    def learner(self) -> str: ...
    @property
    def preset(self) -> str: ...
    @property
    def settings(self) -> Settings: ...


def in_words(config: object) -> dict[str, str]:
    """A configuration as path: words (`sac.lr`: `0.0003`); empty where it is no mapping."""
    values = flat(config) if isinstance(config, dict) else {}
    return {path: str(value).lower() for path, value in values.items()}


def differences(runs: Sequence[Made]) -> dict[str, list[str]]:
    """Settings in which the runs differ: path to each run's words, in the order of the runs."""
    paths = sorted({path for run in runs for path in run.settings})
    rows = {path: [run.settings.get(path, NONE) for run in runs] for path in paths}
    return {path: words for path, words in rows.items() if len(set(words)) > 1}


def variants(runs: Sequence[Made]) -> dict[str, str]:
    """For each run id what sets it apart from runs of its own environment, learner and preset.

    Empty where nothing but the seed does. A setting that a run's version did not have yet sets
    nothing apart, nor do the settings of other learners.
    """
    kinds: dict[tuple[str, str, str], list[Made]] = {}
    for run in runs:
        kinds.setdefault((run.env, run.learner, run.preset), []).append(run)
    found: dict[str, str] = {}
    for (_, learner, _), members in kinds.items():
        apart = {
            path: words
            for path, words in differences(members).items()
            if path not in NO_MATTER and _matters(path, learner) and len(set(words) - {NONE}) > 1
        }
        for i, run in enumerate(members):
            words = [f"{path} {values[i]}" for path, values in apart.items()]
            found[run.run_id] = ", ".join(words)
    return found


def table(runs: Sequence[Made], names: Sequence[str]) -> pd.DataFrame:
    """A row a setting in which the runs differ, a column a run."""
    rows = differences(runs)
    frame = pd.DataFrame(rows, index=pd.Index(_distinct(names))).T
    return frame.rename_axis("setting").reset_index()


def _distinct(names: Sequence[str]) -> list[str]:
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return found


def _matters(path: str, learner: str) -> bool:
    return path.partition(".")[0] not in others_groups(learner)
