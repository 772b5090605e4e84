"""One training, from its configuration to a finished run folder."""

from collections.abc import Callable, Iterator, Sequence

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
    return offline.train(config) if isinstance(config, RoadConfig) else Mbpo(config).events()


def train(
    config: OnlineConfig | RoadConfig,
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
