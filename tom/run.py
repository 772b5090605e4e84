"""One training, from its configuration to a finished run folder; put down and taken up again."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from pydantic import ValidationError

from tom.config import OnlineConfig, RoadConfig, RunConfig, SacRecordingConfig
from tom.data.transitions import Transitions
from tom.errors import UserError
from tom.events import Event, Notice, Tick
from tom.matmul import choose_matmul
from tom.mbpo import Mbpo
from tom.offline import Offline
from tom.record import Recorder, RunReader, RunWriter, Store, checkpoint, open_sink
from tom.sac_recording import SacRecording

AnyConfig = OnlineConfig | RoadConfig | SacRecordingConfig
Consumer = Callable[[Event], None]
STOPPED = "stopped at step {step}: tom train --resume {run} goes on"


class Training(Protocol):
    """What is trained: a generator of events."""

    def events(self) -> Iterator[Event]: ...


@runtime_checkable
class Resumable(Training, Protocol):
    """A training that can be put down at the end of any step."""

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
    torch.set_num_threads(config.threads)
    matmul = choose_matmul(config.matmul)
    run_id = run_id or store.new_run_id(config.env, config.learner, config.seed)
    writer = RunWriter.create(store, run_id, config, matmul=matmul.record(), command=command)
    with Recorder(writer, open_sink(writer) if rerun else None) as recorder:
        _record(make_training(config), recorder, writer, watchers, stop)
    return RunReader(writer.path)


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
    reader = store.run(run_id)
    config = recorded_config(reader)
    if steps is not None:
        config = config.but(steps=steps)
    training = make_training(config)
    if not isinstance(training, Resumable):
        raise UserError(f"a {config.env} {config.learner} run cannot be resumed: start it again")
    held = checkpoint.load(reader.path / checkpoint.FOLDER)
    if held is None:
        raise UserError(f"run '{run_id}' has no checkpoint that is whole: start it again")
    if held.env_step >= config.total_steps:
        raise UserError(
            f"run '{run_id}' is complete at step {held.env_step}: give it more with --steps"
        )
    torch.set_num_threads(config.threads)
    choose_matmul(reader.config["matmul"]["chosen"])
    training.load_state_dict(held.state["training"], *_collected(reader, held.state["training"]))
    writer = RunWriter(reader.path, config)
    mark = held.state["record"]
    with Recorder(writer, open_sink(writer) if rerun else None, mark=mark) as recorder:
        writer.resumed(config, command)
        for problem in held.problems:
            recorder.consume(Notice(held.env_step, "checkpoint", problem))
        _record(training, recorder, writer, watchers, stop)
    return RunReader(writer.path)


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
    recorder: Recorder,
    writer: RunWriter,
    watchers: Sequence[Consumer],
    stop: Stop | None,
) -> None:
    every = writer.config.checkpoint_every
    at = saved_at = 0
    for event in training.events():
        recorder.consume(event)
        for watch in watchers:
            watch(event)
        if not (isinstance(event, Tick) and event.ends_step):
            continue
        at = event.env_step
        asked = stop is not None and stop.asked
        if asked or (every and at % every == 0) or at == writer.config.total_steps:
            _save(training, recorder, writer.path, at)
            saved_at = at
        if asked and at < writer.config.total_steps:
            hint = STOPPED if saved_at else "stopped at step {step}"
            recorder.finish("stopped", hint.format(step=at, run=writer.run_id))
            return


def _save(training: Training, recorder: Recorder, path: Path, env_step: int) -> None:
    if isinstance(training, Resumable):
        state = {"training": training.state_dict(), "record": recorder.mark()}
        checkpoint.save(path / checkpoint.FOLDER, env_step, state)


def _collected(reader: RunReader, state: dict[str, Any]) -> tuple[Transitions, np.ndarray]:
    rows, versions = reader.buffer()
    n = state["collected"]
    if len(rows) < n:
        raise UserError(
            f"run '{reader.run_id}' has lost rows of its buffer ({len(rows)} of {n}): start again"
        )
    return rows[:n], versions[:n]
