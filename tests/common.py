"""What tests of several rooms do: draws, trainings and their stop, states, one-line errors."""

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import pytest
import torch

from tom.config import OnlineConfig, RunConfig
from tom.errors import UserError
from tom.events import Event, Metrics, Tick
from tom.record import RunReader, Store
from tom.record.files import replace_json
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter
from tom.training.presets import resolve
from tom.training.run import Stop

T = TypeVar("T")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def online(
    env: str, learner: str, changes: dict[str, Any] | None = None, preset: str | None = "smoke"
) -> OnlineConfig:
    """The settings of a training in a task other than road-and-rocks."""
    config = resolve(env, learner, preset, changes)
    assert isinstance(config, OnlineConfig)
    return config


def measured(
    store: Store,
    run_id: str,
    learner: str,
    seed: int,
    *steps: tuple[int, dict[Any, float]],
    env: str = "hopper",
    preset: str = "paper",
    **changes: Any,
) -> None:
    """Record a run with these metrics at these steps."""
    config = resolve(env, learner, preset, {"seed": seed, **changes})
    told = ((Metrics(step, values), Tick(step, "evaluate")) for step, values in steps)
    recorded(store, run_id, config, chain.from_iterable(told))


def recorded(
    store: Store,
    run_id: str,
    config: RunConfig,
    events: Iterable[Event],
    *sinks: Any,
    state: Any = "finished",
) -> RunReader:
    """Record these events as a run that ends in this state, and read it back."""
    writer = RunWriter.create(store, run_id, config, command="tom train")
    with Recorder(writer, *sinks) as recorder:
        for event in events:
            recorder.consume(event)
        recorder.finish(state)
    return store.run(run_id)


def change(file: Path, **values: object) -> None:
    """Give keys of a run's JSON file other values."""
    replace_json(file, json.loads(file.read_text()) | values, sync=False)


def cut(file: Path) -> None:
    """Leave the first half of a file."""
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def flip(file: Path, at: int) -> None:
    """Change a bit of the byte at this place."""
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)


def stopping_at(step: int) -> tuple[Stop, tuple[Callable[[Event], None]]]:
    """A stop, and the watcher of a training that asks for it at an env step, once."""
    stop = Stop()

    def watch(event: Event) -> None:
        if event.env_step == step and not stop.asked:
            stop()

    return stop, (watch,)


def present(found: T | None) -> T:
    """What was looked for, which is there."""
    assert found is not None
    return found


def reloaded(state: Any) -> Any:
    """A state as a checkpoint gives it back: saved, and loaded without executing code."""
    file = BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


class Evil:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@contextmanager
def one_line(words: str | None = None, kind: type[UserError] = UserError) -> Iterator[None]:
    """The block is refused, with these words in one line."""
    with pytest.raises(kind, match=words) as raised:
        yield
    assert "\n" not in str(raised.value)
