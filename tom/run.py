"""One training, from its configuration to a finished run folder."""

from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from tom import offline
from tom.config import OnlineConfig, RoadConfig
from tom.events import Event
from tom.matmul import choose_matmul
from tom.mbpo import Mbpo
from tom.record import Recorder, RunReader, RunWriter, Store, open_sink

Consumer = Callable[[Event], None]


def events(config: OnlineConfig | RoadConfig) -> Iterator[Event]:
    """The events of a training: MBPO in a MuJoCo task, or offline on road-and-rocks."""
    if isinstance(config, RoadConfig):
        return offline.train(config)
    return Mbpo(config).events()


def train(
    config: OnlineConfig | RoadConfig,
    store: Store,
    run_id: str | None = None,
    rerun: bool = True,
    watchers: tuple[Consumer, ...] = (),
    command: str = "",
) -> RunReader:
    """Train and record; returns the finished run.

    KeyboardInterrupt ends the run as `stopped` and goes on to the caller; any other error ends
    it as `failed` with its reason. What was recorded until then stays.
    """
    torch.set_num_threads(config.threads)
    matmul = choose_matmul(config.matmul)
    run_id = run_id or store.new_run_id(config.env, config.learner, config.seed)
    writer = RunWriter.create(store, run_id, config, matmul=matmul.record(), command=command)
    recorder = Recorder(writer, open_sink(writer) if rerun else None)
    try:
        for event in events(config):
            recorder.consume(event)
            for watch in watchers:
                watch(event)
    except KeyboardInterrupt:
        recorder.finish("stopped", "interrupted")
        raise
    except Exception as error:
        recorder.finish("failed", f"{type(error).__name__}: {error}")
        raise
    recorder.finish("finished")
    return RunReader(Path(writer.path))
