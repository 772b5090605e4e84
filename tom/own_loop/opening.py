"""The folder of a loop's record: made, or cut back to the step from which the loop goes on.

Unlike our trainings such a loop has no checkpoint here, so its record is cut by what it says.
"""

import shlex
import sys
from dataclasses import fields
from typing import Any, Literal

import numpy as np

from tom.config import OWN_LOOP, OwnLoopConfig
from tom.data.transitions import Transitions
from tom.data.unpack import read_arrays
from tom.envs import ENVS, OTHERS, Task, import_task, task
from tom.envs.gymnasium_task import OWN
from tom.errors import UserError
from tom.record import Store, decode, layout
from tom.record.files import parse_json_line
from tom.record.manage import label
from tom.record.reader import RunReader
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter, TakenError


def resolve_task(env: str) -> Task:
    """The task called `env`, ours if it is Gymnasium's under another name. Raises UserError."""
    ours = {one.gym_id: one.name for one in ENVS.values() if not one.kwargs}
    name = ours.get(env, env)
    if name not in (*ENVS, *OTHERS) and ":" not in name:
        name = f"{OWN}:{name}"
    import_task(name)
    return task(name)


def open_record(
    store: Store,
    name: str,
    settings: OwnLoopConfig,
    resume: Literal["auto"] | None = None,
    step: int | None = None,
) -> Recorder:
    """The record of a new run, or of one that goes on at `step` (None: where it ended)."""
    path, command = store.resolve(name), shlex.join(sys.argv)
    if not (resume and path.exists()):
        try:
            writer = RunWriter.create(store, name, settings, command=command)
        except TakenError as error:
            raise TakenError(f'{error}, or continue it: resume="auto"') from None
        if settings.learner == OWN_LOOP:
            label(store, name, name=name)
        return Recorder(writer)
    run = store.run(name)
    same = {"env": settings.env, "learner": settings.learner}
    if not run.own_loop or any(run.config.get(part) != value for part, value in same.items()):
        raise UserError(f"run '{name}' is of {run.env} and {run.learner}: choose another name")
    writer = RunWriter(path, settings)
    try:
        mark = cut_back(writer, step)
        writer.resumed(settings, command)
    except BaseException:
        writer.close()
        raise
    return Recorder(writer, mark=mark)


def cut_back(writer: RunWriter, step: int | None = None) -> dict[str, Any]:
    """Remove what was recorded after `step` (None: nothing); returns the mark for a `Recorder`.

    Of the buffer that is the rows handed in as a later one than number `step`. Episodes that were
    not over are cut: their last row is truncated.
    """
    reader, last = RunReader(writer.path), np.inf if step is None else step
    lines = [_bytes_up_to(reader, name, last) for name in (layout.METRICS, layout.PROFILES)]
    for steps, name in (
        (reader.snapshot_steps(), layout.snapshot),
        (reader.policy_steps(), layout.policy),
        (reader.evaluation_steps(), layout.episodes),
    ):
        for later in steps:
            if later > last:
                (writer.path / name(later)).unlink(missing_ok=True)
    status, table = reader.status, reader.metric_rows()
    stays = table.loc[table["env_step"] <= last]
    returns = stays["eval/return"].dropna().tolist() if "eval/return" in stays else []
    walls = table["time/wall_s"].dropna().tolist() if "time/wall_s" in table else []
    return {
        "env_step": int(min(status.env_step, last)),
        "wall_s": walls[-1] if walls else 0.0,
        "returns": (returns[-1], max(returns)) if returns else (None, None),
        "next_snapshot": 0.0,
        "files": {
            "lines": [*lines, _bytes_up_to(reader, layout.NOTICES, np.inf)],
            "segment": _cut_buffer(writer, reader, last),
            "latest_snapshot": None,
        },
    }


def _bytes_up_to(reader: RunReader, name: str, last: float) -> int:
    """The size of the rows of a file of JSON lines before the first one of a later step."""
    path, size = reader.path / name, 0
    for line in path.read_bytes().splitlines(keepends=True) if path.exists() else ():
        step = (parse_json_line(line) or {}).get("env_step", 0)
        if step > last or not line.endswith(b"\n"):
            break
        size += len(line)
    return size


def _cut_buffer(writer: RunWriter, reader: RunReader, last: float) -> int:
    """Cut the buffer's segment in which the cut lies; the number of rows that stay in all."""
    first, rows, version = 0, [], []
    for number in layout.numbers(reader.path / layout.BUFFER, ".npz"):
        part, numbers = decode.transitions_of(read_arrays(reader.path / layout.segment(number)))
        # A segment before is right as it is if its last row is followed by one that stays.
        if not rows or (numbers[0] <= last and bool((np.concatenate(version) <= last).all())):
            first, rows, version = number, [], []
        rows.append(part)
        version.append(numbers)
    if not rows:
        return 0
    whole, numbers = Transitions.concatenate(rows), np.concatenate(version)
    kept = np.flatnonzero(numbers <= last)
    if not len(kept):
        return first
    arrays = {field.name: np.asarray(getattr(whole[kept], field.name)) for field in fields(whole)}
    follows = np.append((arrays["obs"][1:] == arrays["next_obs"][:-1]).all(1), False)
    arrays["truncated"] = arrays["truncated"] | ~(follows | arrays["terminated"])
    # Whole and under its name before the later segments go: a kill may come at any time.
    writer.arrays(layout.segment(first), arrays | {"policy_version": numbers[kept]}, sync=True)
    for later in layout.numbers(reader.path / layout.BUFFER, ".npz"):
        if later > first:  # the rows that stay may reach beyond where it began
            (writer.path / layout.segment(later)).unlink()
    return first + len(kept)
