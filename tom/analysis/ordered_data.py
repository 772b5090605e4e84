"""Recorded transitions in the order of their collection: a run's replay buffer or a dataset."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.data.card import Card, make_card, with_rule
from tom.data.datasets import initial_obs, read_dataset, where_else
from tom.data.transitions import TensorTransitions, Transitions
from tom.envs import ENVS, ROAD, Task, task
from tom.errors import UserError
from tom.record import RunReader, Store, layout
from tom.record.task_record import changed

SLACK = 1e-3
"""share of an action's range by which rounding may carry it beyond its bounds"""


@dataclass(frozen=True)
class OrderedData:
    """N transitions in the order of collection, actions in [-1, 1]; random data comes first.

    `policy_version` (N,) says which policy collected each row. If that is not known, every row has
    a version of its own, as in SAC, which changes after every step. `behaviour` (N, 2 A) is the
    Gaussian of each action (`ReplayBuffer.behaviour`), None if nobody says. `initial_obs` (M0, O)
    are the first observations of the episodes; `card` is that of the ordered rows. `run`: the rows
    are those before row `end` of its record; None for other data.
    """

    name: str
    env: str
    transitions: TensorTransitions
    policy_version: Tensor
    initial_obs: Tensor
    card: Card
    ordered_from: int  # rows before it are random data
    end: int
    run: RunReader | None = None
    policy_distance: NDArray[np.float32] | None = None
    """(N,) to the policy of interest (`tom.policy.stored.distances`), once there is one"""
    behaviour: Tensor | None = None

    def __len__(self) -> int:
        return len(self.transitions)


def load_data(
    name: str, store: Store, env: str | None = None, step: int | None = None
) -> OrderedData:
    """Load a run or a weighing with its rows, by id or folder, or a dataset.

    `tom.data.datasets.FORMATS` lists the formats of datasets.

    `env` names the task of a dataset, whose actions are in the task's own units. `step` selects a
    run's buffer as it was at that env step. Raises UserError.
    """
    for path in (Path(name).absolute(), store.path / layout.WEIGHINGS / name):
        if (path / layout.REPORT).is_file():
            if not (path / layout.CONFIG).is_file():
                raise UserError(f"{name} is a weighing that holds no rows: name the run that does")
            return load_run(RunReader(path), step)  # its rows are read as a run's
    run = find_run(name, store)
    if run is not None:
        return load_run(run, step)
    if not Path(name).exists():
        raise UserError(
            f"no data '{name}': name a run of {store.path}/ or a run folder; {where_else(name)}"
        )
    if step is not None:
        raise UserError(
            f"--step {step} is a step of a run, and {name} is not one: leave it out, and name "
            "an earlier policy by its file (RUN/policies/)"
        )
    if env is None:
        raise UserError(f"{name} does not say which task it is of: add --env")
    return _load_dataset(name, env)


def _load_dataset(name: str, env: str) -> OrderedData:
    """The transitions of a dataset, which were recorded in the own units of the task `env`."""
    known = task(env)
    recording = read_dataset(name)
    rows, version, behaviour = recording.rows, recording.policy_version, recording.behaviour
    _check_dims(name, rows, known)
    action, (low, high) = np.asarray(rows.action), known.action_bounds
    slack = SLACK * (high - low)
    outside = (action < low - slack) | (action > high + slack)
    if outside.any():
        row, dim = np.argwhere(outside)[0]
        raise UserError(
            f"{name}: {int(outside.any(1).sum())} of {len(action)} rows have an action outside "
            f"{known.name}'s bounds, first in row {row}: dimension {dim} is {action[row, dim]:g}, "
            f"its bounds are {low[dim]:g} and {high[dim]:g}: give actions in the task's own units, "
            "cut at its bounds where the task cut them (numpy.clip)"
        )
    rows = replace(
        rows,
        action=known.unit_action(action),
        obs=known.unit_obs(np.asarray(rows.obs)),
        next_obs=known.unit_obs(np.asarray(rows.next_obs)),
    ).torch()
    return OrderedData(
        name=Path(name).stem,
        env=env,
        transitions=rows,
        policy_version=torch.arange(1, len(rows) + 1)
        if version is None
        else torch.from_numpy(version),
        initial_obs=torch.as_tensor(initial_obs(rows)),
        card=with_task(recording.card, known, rows),
        ordered_from=0,
        end=len(rows),
        behaviour=None if behaviour is None else torch.from_numpy(behaviour),
    )


def with_task(card: Card, task: Task, rows: Transitions) -> Card:
    """The card beside what the task says of itself; its `rows` are as agents see them."""
    offset, scale = task.obs_units
    card = replace(
        card,
        task=task.name,
        limit=task.max_episode_steps,
        bounds=task.action_bounds,
        seen=card.obs.moved(-offset / scale, 1 / scale),
        others=task.notices,
    )
    if not task.knows_ends:
        return card
    return with_rule(card, task.terminated, rows.torch(), f"of {task.name}")


def card_of_run(rows: Transitions, task: Task) -> Card:
    """The card of rows that a run collected, in the task's own units."""
    low, high = (bound.astype(np.float64) for bound in task.action_bounds)
    card = make_card(rows)
    units = task.obs_units
    card = replace(
        card,
        action=card.action.moved((high + low) / 2, (high - low) / 2),
        obs=card.obs.moved(*units),
        starts=card.starts.moved(*units),
    )
    return with_task(card, task, rows)


def load_run(run: RunReader, step: int | None = None) -> OrderedData:
    """All transitions that a run collected, or its replay buffer at env step `step`.

    Raises UserError if there are none, or no such step.
    """
    if run.env == ROAD:  # road-and-rocks has no policy to play here
        raise UserError(
            f"run {run.run_id} is of {run.env}, which cannot be weighed: name one of "
            + ", ".join((*ENVS, "any Gymnasium task"))
        )
    rows, version, _, behaviour = run.recorded(states=False)
    if run.problems or not len(rows):
        lacking = "buffer" in run.left_out
        nothing = "left out of this small copy" if lacking else "it collected nothing"
        reason = "; ".join(run.problems) or nothing
        raise UserError(f"the replay buffer of run {run.run_id} cannot be used: {reason}")
    known = task(run.env)
    _check_dims(run.run_id, rows, known)
    settings = run.config.get("config", {})
    random_rows = int(settings.get("exploration_steps" if run.fits_model else "steps", 0))
    kept = slice(None)
    if step is not None:
        profiles = run.profiles()
        end = profiles.rows_at(step)
        if run.own_loop and step not in profiles.env_step:
            # All rows before the first that was handed in later.
            end = int(np.append(version > step, True).argmax())
        if not run.fits_model or not 0 < end <= len(rows):
            has = f"{len(rows)} steps" if run.fits_model else "no fits of a model"
            raise UserError(f"run {run.run_id} has {has}: --step {step} is none of them")
        kept = slice(max(end - int(settings.get("replay_capacity", len(rows))), 0), end)
    starts = initial_obs(rows[: kept.stop])  # also of episodes whose rows have left the buffer
    rows, version, behaviour = rows[kept], version[kept], behaviour[kept]
    random_rows -= kept.start or 0
    first = max(min(random_rows, len(rows) - 1), 0)
    card = card_of_run(rows, known)
    if (notice := changed(run)) is not None:
        card = replace(card, others=(*card.others, notice))
    return OrderedData(
        name=run.run_id if run.is_run else str(run.config.get("data", run.run_id)),
        env=run.env,
        transitions=rows.torch(),
        policy_version=torch.from_numpy(version),
        initial_obs=torch.as_tensor(starts),
        card=card,
        ordered_from=first,
        end=(kept.start or 0) + len(rows),
        run=run if run.is_run else None,  # a weighing's folder also holds rows
        behaviour=torch.from_numpy(behaviour) if np.isfinite(behaviour).any() else None,
    )


def to_env_units(run: RunReader, rows: Transitions) -> Transitions:
    """Rows of a run's record in its task's own units; imports no task of the user's."""
    described = run.config.get("task")
    if isinstance(described, dict):
        names = ("action_low", "action_high", "obs_offset", "obs_scale")
        low, high, offset, scale = (np.array(described[name]) for name in names)
    else:
        low, high = task(run.env).action_bounds
        offset, scale = 0.0, 1.0
    obs, next_obs, action = map(np.asarray, (rows.obs, rows.next_obs, rows.action))
    return replace(
        rows,
        obs=(obs * scale + offset).astype(np.float32),
        next_obs=(next_obs * scale + offset).astype(np.float32),
        action=((action * (high - low) + (high + low)) / 2).astype(np.float32),
    )


def find_run(name: str, store: Store) -> RunReader | None:
    """The run called `name`, an id in the store or a folder; None if there is no such run."""
    path = Path(name)
    if (path / "config.json").is_file():
        return Store(path.absolute().parent).run(path.absolute().name)
    inside = "/" not in name and (store.path / name / "config.json").is_file()
    return store.run(name) if inside else None


def _check_dims(name: str, rows: Transitions, task: Task) -> None:
    dims = rows.obs.shape[1], rows.action.shape[1]
    if dims != (task.obs_dim, task.action_dim):
        raise UserError(
            f"{name} has {dims[0]} observations and {dims[1]} actions, {task.name} has "
            f"{task.obs_dim} and {task.action_dim}: is it data of another task or version?"
        )
