"""Resume a training from its newest undamaged checkpoint."""

from typing import Any, Unpack

from pydantic import ValidationError

from tom import plugins
from tom.config import OwnLoopConfig, SacRecordingConfig
from tom.errors import StartAgainError, TryLaterError, UserError, invalid_value, reason
from tom.events import Collected, Notice
from tom.learners import with_own_settings
from tom.readable import flat
from tom.record import RunReader, Store, checkpoint, layout, lock
from tom.record.checkpoint import Checkpoint
from tom.record.files import set_aside
from tom.record.recorder import Recorder
from tom.record.rerun.sink import RerunSink
from tom.record.task_record import changed
from tom.record.versions import ACCEPT, may_change_results, versions
from tom.record.writer import RunWriter
from tom.training.plan import is_done, steps_beyond
from tom.training.presets import config_type
from tom.training.run import (
    AnyConfig,
    RecordingOptions,
    Training,
    make_training,
    make_watch,
    prepare,
    record,
)
from tom.training.watch import Watch

STATE_ERRORS = (LookupError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError)
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
    reader = store.run(run_id)
    if reader.small_copy:
        raise UserError(
            f"run '{run_id}' is a small copy, which cannot be resumed: resume the original run, or "
            "start it again under another name"
        )
    config = resumable_config(reader)
    if steps not in (None, config.steps):
        if isinstance(config, SacRecordingConfig):
            raise UserError(
                "a SAC recording cannot be given other --steps: its halves depend on them; record "
                "a new one"
            )
        config = config.but(steps=steps)
    prepare(config, reader.config.get("matmul", {}).get("chosen", config.matmul))
    notices = [("versions", _changed_versions(reader, accept_versions))]
    if (other := changed(reader)) is not None:
        notices.append(other)
    writer = RunWriter(reader.path, config)  # takes the lock: no other process can write the run
    try:
        saved = _checkpoint(reader, config)
        notices.append(("settings", _changed_settings(reader, saved, config)))
        training = make_training(config)
        watch = make_watch(config, training)
        mark = _restore(reader, saved, training, watch)
        notices += [("checkpoint", text) for text in saved.unusable.values()]
        for path in saved.unusable:  # or they would be among the two that are kept
            set_aside(reader.path, path)
        table = reader.path / layout.METRICS_TABLE
        for name, size in zip(layout.LINES, mark["files"]["lines"], strict=True):
            if (held := (reader.path / name).stat().st_size) < size:
                text = f"{name} has {held} of the {size} bytes that checkpoint {saved.env_step} had"
                notices.append(("rows", f"{text}: rows are lost"))
                if name == layout.METRICS and table.is_file():  # it may have them
                    set_aside(reader.path, table)
    except BaseException:
        writer.close()
        raise
    sink = RerunSink(writer.path) if options.get("rerun", True) else None
    with Recorder(writer, sink, mark=mark) as recorder:
        writer.resumed(config, options.get("command", ""))
        before = [Notice(saved.env_step, kind, text) for kind, text in notices if text]
        record(training, watch, recorder, options, before)
    return RunReader(writer.path)


def find_unfinished(store: Store, config: AnyConfig) -> str | None:
    """The newest resumable run with these settings, or with fewer steps.

    Runs that are being written, and those without an undamaged checkpoint, are skipped. Raises
    TryLaterError for a run whose checkpoints cannot be read for now.
    """
    for reader in store.runs():
        beyond = steps_beyond(config, reader)
        if beyond is None or beyond > 0 or is_done(config, reader) or lock.is_held(reader.path):
            continue
        if checkpoint.load(reader.path / checkpoint.FOLDER) is not None:
            return reader.run_id
    return None


def recorded_config(
    reader: RunReader, otherwise: str = "start it again"
) -> AnyConfig | OwnLoopConfig:
    """The configuration of a run.

    Raises UserError if it needs a plug-in that is not loaded, or comes from another version;
    `otherwise` tells the user what to do then.
    """
    plugins.require(reader.run_id, reader.config.get("plugins"))
    if reader.own_loop:
        kind = with_own_settings(OwnLoopConfig, [reader.learner])
    elif reader.fits_model:
        kind = config_type(reader.env, reader.learner)
    else:
        kind = SacRecordingConfig
    try:
        return kind.model_validate(reader.config["config"])  # pyright: ignore[reportReturnType]
    except (KeyError, ValidationError) as error:
        made_by = reader.config.get("versions", {}).get("tom-studio", "an unknown version")
        unknown = invalid_value(error) if isinstance(error, ValidationError) else "no settings"
        raise UserError(
            f"run '{reader.run_id}' was made by another version ({made_by}; {unknown}): {otherwise}"
        ) from None


def resumable_config(reader: RunReader) -> AnyConfig:
    """The configuration of a run that was trained here. Raises UserError for any other."""
    config = recorded_config(reader)
    if isinstance(config, OwnLoopConfig):
        raise UserError(
            f"run '{reader.run_id}' is of a training loop of your own: start that script again, "
            'with resume="auto"'
        )
    return config


def _changed_versions(reader: RunReader, accepted: bool) -> str:
    """A warning about versions that differ from those of the run's last training, or "".

    Raises UserError if its results would change, unless `accepted`.
    """
    now = versions()
    before = [reader.config, *reader.config.get("resumes", ())][-1].get("versions", {})
    changed = {
        name: f"{name} {before[name]} then, {now[name]} now"
        for name in now
        if before.get(name, now[name]) != now[name]
    }
    decisive = [
        changed[name] for name in changed if may_change_results(name, str(before[name]), now[name])
    ]
    if decisive and not accepted:
        raise UserError(
            f"run '{reader.run_id}' was trained with other versions ({', '.join(decisive)}), and "
            f"its results would change: {ACCEPT} continues with these, or start it again"
        )
    listed = ", ".join(changed.values())
    return f"trained with other versions until here: {listed}" if listed else ""


def _changed_settings(reader: RunReader, saved: Checkpoint, config: AnyConfig) -> str:
    """A warning about settings other than the steps that changed since the checkpoint, or "".

    Raises StartAgainError for a checkpoint of another learner or environment.
    """
    before, now = saved.state.get("config", {}), config.model_dump(mode="json")
    for name in ("learner", "env"):
        if before.get(name) != now[name]:
            raise StartAgainError(
                f"the checkpoint of run '{reader.run_id}' at step {saved.env_step} is of {name} "
                f"{before.get(name)}, not {now[name]}: put back its config.json, or start it again"
            )
    old, new = flat(before), flat(now)
    changed = [name for name in new if name != "steps" and old.get(name, new[name]) != new[name]]
    listed = ", ".join(f"{name} ({old[name]}, now {new[name]})" for name in changed)
    since = "settings were changed since the checkpoint"
    return f"{since}: {listed}; results may differ" if listed else ""


def _checkpoint(reader: RunReader, config: AnyConfig) -> Checkpoint:
    """The checkpoint to go on from. Raises UserError if there is none or nothing is left to do."""
    saved = checkpoint.load(reader.path / checkpoint.FOLDER)
    if saved is None:
        raise StartAgainError(
            f"run '{reader.run_id}' has no checkpoint that is whole: start it again"
        )
    same_end = saved.state.get("config", {}).get("steps") == config.steps
    at_end = saved.env_step == config.total_steps and same_end
    # A run that ended at its last checkpoint, but had not finished, lacks its exam and policy.
    ended = reader.status.state == "finished" or not at_end
    if saved.env_step >= config.total_steps and ended:
        raise UserError(
            f"run '{reader.run_id}' is complete at step {saved.env_step}: give it more with --steps"
        )
    return saved


def _restore(
    reader: RunReader, saved: Checkpoint, training: Training, watch: Watch
) -> dict[str, Any]:
    """Restore `training` from the checkpoint and the buffer; returns the mark of its record."""
    try:
        n = saved.state["training"]["collected"]
        rows, version, _, behaviour = reader.recorded(states=False)
        if len(rows) < n and reader.unread:
            raise TryLaterError(
                f"run '{reader.run_id}' cannot be read for now ({reader.unread[0]}): nothing was "
                "changed; check its disk and try again"
            )
        if len(rows) < n:
            raise StartAgainError(
                f"run '{reader.run_id}' has lost rows of its buffer ({len(rows)} of {n}): start it "
                "again"
            )
        collected = Collected(saved.env_step, rows[:n], version[:n], behaviour=behaviour[:n])
        training.load_state_dict(saved.state["training"], collected)
        watch.load_state_dict(saved.state["watch"])
        return saved.state["record"]
    except STATE_ERRORS as error:
        raise StartAgainError(
            f"the checkpoint of run '{reader.run_id}' at step {saved.env_step} is another "
            f"version's ({type(error).__name__}: {reason(error)}): start it again"
        ) from error
