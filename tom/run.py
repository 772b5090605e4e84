"""One training, from its configuration to a finished run folder; put down and taken up again."""

from collections.abc import Callable, Generator, Iterator, Sequence
from time import perf_counter
from typing import Any, Protocol

import numpy as np
import torch
from pydantic import ValidationError

from tom.config import OnlineConfig, RoadConfig, RunConfig, SacRecordingConfig
from tom.data.transitions import Transitions
from tom.errors import UserError
from tom.events import Event, Notice, Tick
from tom.health import Watch
from tom.lockstep import Work, finished
from tom.matmul import choose_matmul
from tom.mbpo import Mbpo
from tom.memory import keep_freed_memory
from tom.offline import Offline
from tom.record import Recorder, RunReader, RunWriter, Store, checkpoint, lock, open_sink
from tom.record.checkpoint import Checkpoint
from tom.record.heartbeat import BEAT_S
from tom.record.writer import TakenError
from tom.sac_recording import SacRecording

AnyConfig = OnlineConfig | RoadConfig | SacRecordingConfig
Consumer = Callable[[Event], None]
Recorded = Generator[Work, None, RunReader]
STOPPED = "stopped at step {step}: tom train --resume {run} goes on"


class Training(Protocol):
    """A generator of events that can be put down at the end of any step and taken up again."""

    def events(self) -> Iterator[Event]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(
        self, state: dict[str, Any], collected: Transitions, policy_version: np.ndarray
    ) -> None: ...


class Stop:
    """Asks a training to stop at the end of its step; asked twice, it stops at once."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def make_training(config: AnyConfig) -> Training:
    """MBPO in a MuJoCo task, offline on road-and-rocks, or SAC alone."""
    match config:
        case OnlineConfig():
            return Mbpo(config)
        case RoadConfig():
            return Offline(config)
        case SacRecordingConfig():
            return SacRecording(config)


def train(
    config: AnyConfig,
    store: Store,
    run_id: str | None = None,
    rerun: bool = True,
    watchers: Sequence[Consumer] = (),
    command: str = "",
    stop: Stop | None = None,
) -> RunReader:
    """Train and record; returns the run.

    A run that `stop` asked to stop is left as `stopped` with a checkpoint. KeyboardInterrupt ends
    it as `stopped` at once, any other error as `failed` with its reason; both go on to the
    caller. What was recorded until then stays.
    """
    return finished(recorded(config, store, run_id, rerun, watchers, command, stop))


def recorded(
    config: AnyConfig,
    store: Store,
    run_id: str | None = None,
    rerun: bool = True,
    watchers: Sequence[Consumer] = (),
    command: str = "",
    stop: Stop | None = None,
) -> Recorded:
    """`train` as a member of a fleet runs it: its heavy work is handed out."""
    keep_freed_memory()
    torch.set_num_threads(config.threads)
    matmul = choose_matmul(config.matmul)
    writer = _new_writer(store, run_id, config, matmul=matmul.record(), command=command)
    with Recorder(writer, open_sink(writer) if rerun else None) as recorder:
        training = make_training(config)
        yield from _record(training, Watch(config), recorder, writer, watchers, stop)
    return RunReader(writer.path)


def _new_writer(store: Store, run_id: str | None, config: AnyConfig, **how: Any) -> RunWriter:
    """The writer of a new run; a name that is made up here is free, also when two start at once."""
    if run_id is not None:
        return RunWriter.create(store, run_id, config, **how)
    while True:
        made_up = store.new_run_id(config.env, config.learner, config.seed)
        try:
            return RunWriter.create(store, made_up, config, **how)
        except TakenError:
            continue


def resume(
    store: Store,
    run_id: str,
    steps: int | None = None,
    rerun: bool = True,
    watchers: Sequence[Consumer] = (),
    command: str = "",
    stop: Stop | None = None,
) -> RunReader:
    """Go on with a run from its newest whole checkpoint, to `steps` where given.

    On the same machine with the same versions the result is bit for bit that of a run never
    interrupted. Raises UserError where the run cannot go on.
    """
    return finished(resumed(store, run_id, steps, rerun, watchers, command, stop))


def resumed(
    store: Store,
    run_id: str,
    steps: int | None = None,
    rerun: bool = True,
    watchers: Sequence[Consumer] = (),
    command: str = "",
    stop: Stop | None = None,
) -> Recorded:
    """`resume` as a member of a fleet runs it: its heavy work is handed out."""
    keep_freed_memory()
    reader = store.run(run_id)
    config = recorded_config(reader)
    if steps is not None:
        config = _with_steps(config, steps)
    if reader.status.alive:
        lock.refuse_if_elsewhere(reader.path, lambda: reader.status.heartbeat, 2.5 * BEAT_S)
    writer = RunWriter(reader.path, config)  # from here on no other process writes the run
    try:
        held = _checkpoint(reader, config)
        torch.set_num_threads(config.threads)
        choose_matmul(reader.config.get("matmul", {}).get("chosen", config.matmul))
        training, watch = make_training(config), Watch(config)
        mark = _go_on(reader, held, training, watch)
    except BaseException:
        writer.close()
        raise
    held.drop_unusable()
    with Recorder(writer, open_sink(writer) if rerun else None, mark=mark) as recorder:
        writer.resumed(config, command)
        for problem in held.problems:
            recorder.consume(Notice(held.env_step, "checkpoint", problem))
        yield from _record(training, watch, recorder, writer, watchers, stop)
    return RunReader(writer.path)


def _with_steps(config: AnyConfig, steps: int) -> AnyConfig:
    if isinstance(config, SacRecordingConfig) and steps != config.steps:
        raise UserError(
            "a SAC recording cannot be given other --steps: its halves depend on them; record anew"
        )
    return config.but(steps=steps)


def _checkpoint(reader: RunReader, config: AnyConfig) -> Checkpoint:
    held = checkpoint.load(reader.path / checkpoint.FOLDER)
    if held is None:
        raise UserError(f"run '{reader.run_id}' has no checkpoint that is whole: start it again")
    if held.env_step >= config.total_steps:
        raise UserError(
            f"run '{reader.run_id}' is complete at step {held.env_step}: give it more with --steps"
        )
    return held


def unfinished(store: Store, config: AnyConfig) -> str | None:
    """The newest run with these settings, or with fewer steps, that can go on to its last one.

    Runs that are being written, and those without a whole checkpoint, are passed over.
    """
    wanted = config.model_dump(mode="json")
    for reader in store.runs():
        given = reader.config.get("config")
        if not isinstance(given, dict) or given.get("steps", 0) > config.steps:
            continue
        if reader.learner == "sac" and given.get("steps") != config.steps:
            continue  # the halves of a recording depend on them
        if {**given, "steps": config.steps} != wanted or lock.held(reader.path):
            continue
        held = checkpoint.load(reader.path / checkpoint.FOLDER)
        if held is not None and held.env_step < config.total_steps:
            return reader.run_id
    return None


def _go_on(reader: RunReader, held: Checkpoint, training: Training, watch: Watch) -> dict[str, Any]:
    """Put `training` where it stood; returns where its record stood."""
    try:
        state = held.state["training"]
        training.load_state_dict(state, *_collected(reader, state["collected"]))
        if "watch" in held.state:
            watch.load_state_dict(held.state["watch"])
        return held.state["record"]
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        reason = str(error).partition("\n")[0]
        raise UserError(
            f"the checkpoint of run '{reader.run_id}' at step {held.env_step} is another "
            f"version's ({type(error).__name__}: {reason}): start it again"
        ) from error


def recorded_config(reader: RunReader) -> AnyConfig:
    """The configuration a run was made with. Raises UserError where it is another version's."""
    kinds: dict[bool, type[RunConfig]] = {True: RoadConfig, False: OnlineConfig}
    kind = SacRecordingConfig if reader.learner == "sac" else kinds[reader.env == "road-and-rocks"]
    try:
        return kind.model_validate(reader.config["config"])  # pyright: ignore[reportReturnType]
    except (KeyError, ValidationError) as error:
        made_by = reader.config.get("versions", {}).get("tom-studio", "an unknown version")
        first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": error.args}
        where = ".".join(str(part) for part in first["loc"])
        raise UserError(
            f"run '{reader.run_id}' was made by another version ({made_by}; its setting {where} "
            "is not known): start it again"
        ) from None


def _record(
    training: Training,
    watch: Watch,
    recorder: Recorder,
    writer: RunWriter,
    watchers: Sequence[Consumer],
    stop: Stop | None,
) -> Generator[Work, None, None]:
    every, total = writer.config.checkpoint_every, writer.config.total_steps
    listening = list(watchers)
    steps = training.algorithm() if isinstance(training, Mbpo) else training.events()
    for event in watch.over(steps):
        if isinstance(event, Work):
            yield event
            continue
        recorder.consume(event)
        _tell(listening, event)
        if not (isinstance(event, Tick) and event.ends_step):
            continue
        at = event.env_step
        asked = stop is not None and stop.asked
        if asked or (every and at % every == 0) or at == total:
            _save(training, watch, recorder, writer, at)
        if asked and at < total:
            saved = checkpoint.newest(writer.path / checkpoint.FOLDER)
            hint = STOPPED if saved is not None else "stopped at step {step}, no checkpoint"
            recorder.finish("stopped", hint.format(step=at, run=writer.run_id))
            return


def _tell(watchers: list[Consumer], event: Event) -> None:
    """Pass an event on; a watcher whose terminal or pipe is gone is dropped, the run goes on."""
    for watcher in tuple(watchers):
        try:
            watcher(event)
        except OSError:
            watchers.remove(watcher)


def _save(
    training: Training, watch: Watch, recorder: Recorder, writer: RunWriter, env_step: int
) -> None:
    """Write a checkpoint; where the disk refuses it, the one before stays and training goes on."""
    begun = perf_counter()
    try:
        state = {
            "training": training.state_dict(),
            "watch": watch.state_dict(),
            "record": recorder.mark(),
        }
        checkpoint.save(writer.path / checkpoint.FOLDER, env_step, state)
    except OSError as error:
        before = checkpoint.newest(writer.path / checkpoint.FOLDER)
        stays = "there is none yet" if before is None else f"that of step {before} stays"
        message = f"no checkpoint could be written ({error}): {stays}; free some space"
        recorder.consume(Notice(env_step, "checkpoint", message))
    recorder.checkpoint_took(perf_counter() - begun)


def _collected(reader: RunReader, n: int) -> tuple[Transitions, np.ndarray]:
    rows, versions = reader.buffer()
    if len(rows) < n:
        raise UserError(
            f"run '{reader.run_id}' has lost rows of its buffer ({len(rows)} of {n}): start again"
        )
    return rows[:n], versions[:n]
