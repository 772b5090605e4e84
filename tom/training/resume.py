"""Resume a training from its newest undamaged checkpoint."""

from typing import Any, Unpack

import numpy as np
import torch
from pydantic import ValidationError

from tom import plugins
from tom.config import SacRecordingConfig, completed
from tom.data.transitions import Transitions
from tom.errors import StartAgainError, TryLaterError, UserError, reason
from tom.events import Notice
from tom.machine.device import require_device
from tom.machine.matmul import choose_matmul
from tom.machine.memory import keep_freed_memory
from tom.record import RunReader, Store, checkpoint, lock
from tom.record.checkpoint import Checkpoint
from tom.record.integrity import unlike
from tom.record.recorder import Recorder
from tom.record.rerun.sink import open_sink
from tom.record.status import BEAT_S
from tom.record.writer import RunWriter
from tom.training.presets import config_type
from tom.training.resume_checks import check_training, check_versions
from tom.training.run import AnyConfig, RecordingOptions, Training, make_training, record
from tom.training.watch import Watch

UNFIT = (LookupError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError)
"""errors that loading the state of another kind of training may raise"""


def resume(
    store: Store,
    run_id: str,
    steps: int | None = None,
    *,
    accept_versions: bool = False,
    **options: Unpack[RecordingOptions],
) -> RunReader:
    """Resume a run from its newest undamaged checkpoint, up to `steps` if given.

    On the same machine with the same versions the result is bit for bit that of an uninterrupted
    run. Other versions of packages that affect it are refused unless `accept_versions`. Raises
    UserError if the run cannot be resumed; StartAgainError if it never can.
    """
    keep_freed_memory()
    reader = store.run(run_id)
    if reader.small_copy:
        raise UserError(
            f"run '{run_id}' is a small copy, which cannot go on: resume the run that it is of, or "
            "start it again under another name"
        )
    config = recorded_config(reader)
    if steps is not None:
        config = _with_steps(config, steps)
    _require_own_device(reader, config)
    said = [("versions", check_versions(reader, accept_versions))]
    if reader.status.state == "running":  # alive or not: its machine's clock may be another
        lock.refuse_if_elsewhere(
            reader.path, lambda: RunReader(reader.path).status.heartbeat, 2.5 * BEAT_S
        )
    writer = RunWriter(reader.path, config)  # takes the lock: no other process can write the run
    try:
        held = _checkpoint(reader, config)
        _refuse_lost_rows(reader, held)
        torch.set_num_threads(config.threads)
        choose_matmul(reader.config.get("matmul", {}).get("chosen", config.matmul))
        training, watch = make_training(config), Watch(config)
        said.append(("settings", check_training(reader, held, config, training)))
        mark = _go_on(reader, held, training, watch)
        held.set_unusable_aside(reader.path)
    except BaseException:
        writer.close()
        raise
    sink = open_sink(writer) if options.get("rerun", True) else None
    with Recorder(writer, sink, mark=mark) as recorder:
        writer.resumed(config, options.get("command", ""))
        said += [("checkpoint", text) for text in held.problems]
        before = [Notice(held.env_step, kind, text) for kind, text in said if text]
        record(training, watch, recorder, writer, options, before)
    return RunReader(writer.path)


def unfinished(
    store: Store, config: AnyConfig, *, shorter: bool = True, run_id: str | None = None
) -> str | None:
    """The newest resumable run with these settings, or if `shorter` with fewer steps.

    Runs that are being written, and those without an undamaged checkpoint, are skipped. A `run_id`
    leaves out all others, and may be of more steps. Raises TryLaterError for a run whose
    checkpoints cannot be read for now.
    """
    wanted = completed(config.model_dump(mode="json"))
    for reader in store.runs():
        if run_id not in (None, reader.run_id):
            continue
        given = reader.config.get("config")
        if not isinstance(given, dict) or not isinstance(given.get("steps"), int):
            continue  # damaged
        if given["steps"] > config.steps and run_id is None:
            continue
        if given["steps"] != config.steps and not (shorter and reader.fits_model):
            continue  # the halves of a recording depend on its steps
        if given["steps"] == config.steps and reader.status.state == "finished":
            continue  # although its last checkpoint may be of an earlier step, if the disk was full
        if {**given, "steps": config.steps} != wanted or lock.held(reader.path):
            continue
        held = _newest(reader)
        if held is not None and not _complete(reader, held, config):
            return reader.run_id
    return None


def recorded_config(reader: RunReader, otherwise: str = "start it again") -> AnyConfig:
    """The configuration of a run.

    Raises UserError if it needs a plug-in that is not loaded, or comes from another version;
    `otherwise` tells the user what to do then.
    """
    plugins.require(reader.run_id, reader.config.get("plugins"))
    kind = config_type(reader.env, reader.learner) if reader.fits_model else SacRecordingConfig
    try:
        return kind.model_validate(reader.config["config"])  # pyright: ignore[reportReturnType]
    except (KeyError, ValidationError) as error:
        made_by = reader.config.get("versions", {}).get("tom-studio", "an unknown version")
        first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": error.args}
        where = ".".join(str(part) for part in first["loc"])
        raise UserError(
            f"run '{reader.run_id}' was made by another version ({made_by}; its setting {where} "
            f"is not known): {otherwise}"
        ) from None


def _with_steps(config: AnyConfig, steps: int) -> AnyConfig:
    if isinstance(config, SacRecordingConfig) and steps != config.steps:
        raise UserError(
            "a SAC recording cannot be given other --steps: its halves depend on them; record anew"
        )
    return config.but(steps=steps)


def _require_own_device(reader: RunReader, config: AnyConfig) -> None:
    """Raises UserError for another device than the run's, because its random streams differ."""
    try:
        require_device(config.device)
    except UserError:
        raise UserError(
            f"run '{reader.run_id}' trains on {config.device}, which torch does not find here: go "
            "on where it is, or start the run again with --device cpu"
        ) from None


def _newest(reader: RunReader) -> Checkpoint | None:
    """The run's newest undamaged checkpoint. Raises UserError if it may have one, unread."""
    held, unread = checkpoint.look_for(reader.path / checkpoint.FOLDER)
    if held is None and unread:
        raise _not_now(reader, unread)
    return held


def _checkpoint(reader: RunReader, config: AnyConfig) -> Checkpoint:
    held = _newest(reader)
    if held is None:
        raise StartAgainError(
            f"run '{reader.run_id}' has no checkpoint that is whole: start it again"
        )
    if _complete(reader, held, config):
        raise UserError(
            f"run '{reader.run_id}' is complete at step {held.env_step}: give it more with --steps"
        )
    return held


def _refuse_lost_rows(reader: RunReader, held: Checkpoint) -> None:
    """Raises UserError for rows that a resume would lose for good."""
    if lost := unlike(reader.path, held):
        raise UserError(
            f"run '{reader.run_id}' has lost rows ({'; '.join(lost)}): `tom runs repair "
            f"{reader.run_id}` puts back what it can, then resume"
        )


def _complete(reader: RunReader, held: Checkpoint, config: AnyConfig) -> bool:
    """Whether nothing of the run is left to do.

    A run that ended after its last checkpoint, but before it had finished, lacks its last rows,
    exam and policy.
    """
    if held.env_step < config.total_steps:
        return False
    planned = held.state.get("config")
    same_end = isinstance(planned, dict) and planned.get("steps") == config.steps
    at_end = held.env_step == config.total_steps and same_end
    return not at_end or reader.status.state == "finished"


def _go_on(reader: RunReader, held: Checkpoint, training: Training, watch: Watch) -> dict[str, Any]:
    """Restore `training` from the checkpoint; returns the mark of its record."""
    try:
        state = held.state["training"]
        training.load_state_dict(state, *_collected(reader, state["collected"]))
        if "watch" in held.state:
            watch.load_state_dict(held.state["watch"])
        return held.state["record"]
    except UNFIT as error:
        raise StartAgainError(
            f"the checkpoint of run '{reader.run_id}' at step {held.env_step} is another "
            f"version's ({type(error).__name__}: {reason(error)}): start it again"
        ) from error


def _collected(reader: RunReader, n: int) -> tuple[Transitions, np.ndarray]:
    rows, versions = reader.buffer()
    if len(rows) < n:
        if reader.unread:
            raise _not_now(reader, reader.unread[0])
        raise StartAgainError(
            f"run '{reader.run_id}' has lost rows of its buffer ({len(rows)} of {n}): start it "
            "again"
        )
    return rows[:n], versions[:n]


def _not_now(reader: RunReader, problem: str) -> TryLaterError:
    """The refusal of a run that has a file which cannot be read for now."""
    return TryLaterError(
        f"run '{reader.run_id}' cannot be read for now ({problem}): nothing was changed; see to "
        "its disk and try again"
    )
