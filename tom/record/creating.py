"""Make a new run folder, whose `config.json` has everything that a run was started with."""

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tom import plugins
from tom.config import RunConfig
from tom.errors import DISK_FULL, TryLaterError, UserError
from tom.record import layout
from tom.record.files import replace_json, whole_folder
from tom.record.store import Store
from tom.record.versions import git_commit, machine, versions


class TakenError(UserError):
    """A run of that name exists already."""


def make_folder(store: Store, run_id: str, config: RunConfig, matmul: object, command: str) -> Path:
    """Make the run folder, `config.json` first; it appears whole or not at all.

    `matmul` is the result of the probe for fast matrix products (any JSON value).
    Raises UserError if the id is invalid or taken, or if the store cannot be written.
    """
    from tom.record.task_record import save_scene  # a simulator takes a second to import

    path = store.resolve(run_id)
    store.ensure_writable()
    if os.path.lexists(path):
        raise _taken(run_id)
    try:
        with whole_folder(path) as unfinished:
            for folder in layout.FOLDERS:
                (unfinished / folder).mkdir()
            content = _describe(run_id, config, matmul, command)
            replace_json(unfinished / layout.CONFIG, content, sync=True)
            save_scene(config.env, unfinished)
    except OSError as error:
        if path.exists():  # another writer was first
            raise _taken(run_id) from error
        kind = TryLaterError if error.errno in DISK_FULL else UserError
        raise kind(f"cannot make run {run_id}: {error}") from error
    return path


def _describe(run_id: str, config: RunConfig, matmul: object, command: str) -> dict[str, Any]:
    from tom.record.task_record import description

    task = description(config.env)
    return {
        "schema": layout.SCHEMA,
        "run_id": run_id,
        "env": config.env,
        "learner": config.learner,
        "seed": config.seed,
        "preset": config.preset,
        "config": config.model_dump(mode="json"),
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(),
        "matmul": matmul,
        "command": command,
        "created": datetime.now(UTC).isoformat(),
        **({} if task is None else {"task": task}),
        **({"plugins": needed} if (needed := plugins.needed(config)) else {}),
    }


def _taken(run_id: str) -> TakenError:
    return TakenError(f"run '{run_id}' exists already: choose another run id")
