"""One training, from its configuration to a finished run folder."""

from collections.abc import Callable, Iterator, Sequence

import torch

from tom import offline
from tom.config import OnlineConfig, RoadConfig, SacRecordingConfig
from tom.events import Event
from tom.matmul import choose_matmul
from tom.mbpo import Mbpo
from tom.record import Recorder, RunReader, RunWriter, Store, open_sink
from tom.sac_recording import SacRecording

Consumer = Callable[[Event], None]


AnyConfig = OnlineConfig | RoadConfig | SacRecordingConfig


def events(config: AnyConfig) -> Iterator[Event]:
    """The events of a run: MBPO in a MuJoCo task, offline on road-and-rocks, or SAC alone."""
    match config:
        case OnlineConfig():
            return Mbpo(config).events()
        case RoadConfig():
            return offline.train(config)
        case SacRecordingConfig():
            return SacRecording(config).events()


def train(
    config: AnyConfig,
    store: Store,
    run_id: str | None = None,
    rerun: bool = True,
    watchers: Sequence[Consumer] = (),
    command: str = "",
) -> RunReader:
    """Train and record; returns the finished run.

    KeyboardInterrupt ends the run as `stopped`, any other error as `failed` with its reason, and
    goes on to the caller. What was recorded until then stays.
    """
    torch.set_num_threads(config.threads)
    matmul = choose_matmul(config.matmul)
    run_id = run_id or store.new_run_id(config.env, config.learner, config.seed)
    writer = RunWriter.create(store, run_id, config, matmul=matmul.record(), command=command)
    with Recorder(writer, open_sink(writer) if rerun else None) as recorder:
        for event in events(config):
            recorder.consume(event)
            for watch in watchers:
                watch(event)
    return RunReader(writer.path)
