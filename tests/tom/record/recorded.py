"""The events of a small run, every kind of them."""

from pathlib import Path

import numpy as np
import pandas as pd
from rerun.chunk import RrdReader

from tom.config import OnlineConfig
from tom.data.transitions import Transitions
from tom.events import Collected, Episode, Evaluation, Event, Field, Metrics, Notice, Tick, Weights

OBS, ACTION, NQ = 11, 3, 6
STEPS, FIT, EVALUATE = 1000, 100, 500

Config = OnlineConfig(env="hopper", learner="tom", seed=3, steps=STEPS, snapshots=3)


def transitions(first: int, count: int) -> Transitions:
    """Rows whose every number tells which row of the buffer it is."""
    row = np.arange(first, first + count, dtype=np.float32)
    obs = np.repeat(row[:, None], OBS, 1)
    flags = row % 7 == 0, row % 5 == 0
    return Transitions(obs, np.repeat(row[:, None] / 10, ACTION, 1), row, obs + 1, *flags)


def weights(step: int) -> Weights:
    """Weight i + 1 for row i, so that every mean is known."""
    row = np.arange(step, dtype=np.float32)
    return Weights(step, row + 1, log_ratio=-row)


def episodes(step: int) -> list[Episode]:
    """Two episodes of 4 and 6 steps with returns 4 * step and 6 * step."""
    return [
        Episode(
            reward=np.full(h, step, np.float32),
            action=np.full((h, ACTION), 0.5, np.float32),
            obs=np.arange((h + 1) * OBS, dtype=np.float32).reshape(h + 1, OBS),
            qpos=np.arange((h + 1) * NQ, dtype=np.float32).reshape(h + 1, NQ),
            qvel=np.zeros((h + 1, NQ), np.float32),
            terminated=h == 4,
            truncated=h == 6,
            info={"success": float(h == 4)},
        )
        for h in (4, 6)
    ]


def events() -> list[Event]:
    """The events of a run of STEPS steps."""
    found: list[Event] = []
    for step in range(1, STEPS + 1):
        if step % FIT == 0:
            rows = transitions(step - FIT, FIT)
            found.append(Collected(step, rows, np.full(FIT, step // FIT)))
            found.append(weights(step))
            found.append(Metrics(step, {"model/holdout_nll": -step / 10, "critic/q": np.inf}))
        if step % EVALUATE == 0:
            found.append(Evaluation(step, episodes(step if step == EVALUATE else -step)))
            found.append(Field(step, "map", {"gain": np.full((2, 3), step)}))
            found.append(Notice(step, "weights", "all of them are zero"))
        found.append(Tick(step, "optimise"))
    return found


def files(folder: Path) -> dict[str, bytes]:
    """The content of all files but those whose names begin with a dot."""
    found = [p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in found}


def logged(path: Path, entity: str) -> pd.DataFrame:
    """What a Rerun recording holds at `entity`: a row a time, `env_step` and the components."""
    chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == f"/{entity}"]
    tables = [pd.DataFrame(chunk.to_record_batch().to_pydict()) for chunk in chunks]
    timed = [table for table in tables if "env_step" in table]
    return pd.concat(timed).sort_values("env_step", kind="stable") if timed else pd.DataFrame()
