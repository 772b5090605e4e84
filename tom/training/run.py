"""One training, from its configuration to a finished run folder."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import chain
from typing import Literal, TypedDict, Unpack

import torch

from tom.config import OnlineConfig, RoadConfig, SacRecordingConfig
from tom.errors import UserError, reason
from tom.events import Event, Notice, Tick
from tom.machine.matmul import MatmulReport, choose_matmul
from tom.machine.memory import keep_freed_memory
from tom.mbpo import Mbpo
from tom.offline import Offline
from tom.record import RunReader, Store, checkpoint
from tom.record.recorder import Recorder
from tom.record.rerun.sink import RerunSink
from tom.record.writer import RunWriter
from tom.training.sac_recording import SacRecording
from tom.training.watch import Watch

AnyConfig = OnlineConfig | RoadConfig | SacRecordingConfig
Training = Mbpo | Offline | SacRecording
"""a generator of events whose state can be saved at the end of any step and restored"""
Consumer = Callable[[Event], None]
STOPPED = "stopped at step {step}: tom train --resume {run} continues it"


class RecordingOptions(TypedDict, total=False):
    """How a training is recorded and watched; no option changes the training itself."""

    rerun: bool  # also write a recording for Rerun [True]
    watchers: Sequence[Consumer]  # called with every event
    command: str  # the command line that started it
    stop: "Stop | None"  # can end it early [None]


class Stop:
    """A request to stop a training at the end of its step; a second request stops it at once."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def prepare(config: AnyConfig, matmul: Literal["auto", "default", "onednn"]) -> MatmulReport:
    """Set this process up for a training; the result of the probe for fast matrix products.

    Raises UserError unless torch can use the config's device, cpu or cuda, here.
    """
    device = config.device
    if device.partition(":")[0] not in ("cpu", "cuda"):
        raise UserError(f"--device {device}: must be cpu or cuda")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UserError(
            f"--device {device} cannot be used here ({reason(error)}): train with --device cpu"
        ) from None
    keep_freed_memory()
    torch.set_num_threads(config.threads)
    return choose_matmul(matmul)


def make_training(config: AnyConfig) -> Training:
    """The training for a configuration: MBPO, offline on road-and-rocks, or SAC alone."""
    match config:
        case OnlineConfig():
            return Mbpo(config)
        case RoadConfig():
            return Offline(config)
        case SacRecordingConfig():
            return SacRecording(config)


def make_watch(config: AnyConfig, training: Training) -> Watch:
    return Watch(config, training.replay if isinstance(training, Mbpo | SacRecording) else None)


def train(
    config: AnyConfig, store: Store, run_id: str | None = None, **options: Unpack[RecordingOptions]
) -> RunReader:
    """Train and record; returns the run.

    After a request by `stop` the run ends as `stopped` with a checkpoint. KeyboardInterrupt ends it
    as `stopped` at once, any other error as `failed` with its reason; both are raised again. The
    record up to then stays. Raises UserError if the config's device does not exist.
    """
    matmul = asdict(prepare(config, config.matmul))
    writer = RunWriter.create(store, run_id, config, matmul, options.get("command", ""))
    sink = RerunSink(writer.path) if options.get("rerun", True) else None
    with Recorder(writer, sink) as recorder:
        training = make_training(config)
        record(training, make_watch(config, training), recorder, options)
    return RunReader(writer.path)


def record(
    training: Training,
    watch: Watch,
    recorder: Recorder,
    options: RecordingOptions,
    before: Sequence[Notice] = (),
) -> None:
    """Run a training to its end, or until `stop`, and record every event.

    `before` are events that come first. A watcher whose terminal or pipe is closed is dropped.
    """
    writer = recorder.writer
    every, total = writer.config.checkpoint_every, writer.config.total_steps
    watchers, stop = list(options.get("watchers", ())), options.get("stop")
    for event in chain(before, watch.checked(training.events())):
        recorder.consume(event)
        for watcher in tuple(watchers):
            try:
                watcher(event)
            except OSError:
                watchers.remove(watcher)
        if not (isinstance(event, Tick) and event.ends_step):
            continue
        at = event.env_step
        asked = stop is not None and stop.asked
        if asked or (every and at % every == 0) or at == total:
            recorder.save({"training": training.state_dict(), "watch": watch.state_dict()})
        if asked and at < total:
            saved = checkpoint.newest(writer.path / checkpoint.FOLDER)
            hint = STOPPED if saved is not None else "stopped at step {step}, no checkpoint"
            recorder.finish("stopped", hint.format(step=at, run=writer.run_id))
            return
