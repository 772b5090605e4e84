"""Many trainings of one environment in one process: learners and seeds in lock-step.

Each member is an ordinary run with its own random streams, buffers, environment and run folder;
what a fleet adds is that their networks are stacked and stepped as one (see `lockstep`). On a GPU
that is what fills it; on a CPU it brings nothing, and seeds are processes there.
"""

from collections.abc import Sequence
from typing import Unpack

from tom.config import OnlineConfig
from tom.errors import UserError
from tom.machine.device import require_device
from tom.nn.lockstep import Lockstep
from tom.record import RunReader, Store
from tom.training.plan import Trial, same_run
from tom.training.resume import resumed, unfinished
from tom.training.run import Consumer, Recorded, RecordingOptions, Stop, recorded


def train_fleet(
    trials: Sequence[Trial],
    store: Store,
    rerun: bool = True,
    watchers: Sequence[Sequence[Consumer]] = (),
    command: str = "",
    stop: Stop | None = None,
    accept_versions: bool = False,
) -> list[RunReader | Exception]:
    """Train all of them, those of the store that are not finished from their checkpoints.

    Returns each one's run, or the error that ended it; `watchers` are each one's own;
    `accept_versions` as for `resume`. Raises UserError where they cannot be a fleet.
    """
    check(trials)
    watching = watchers or [()] * len(trials)
    runs = store.runs()
    options = [
        RecordingOptions(rerun=rerun, watchers=own, command=command, stop=stop) for own in watching
    ]
    members = [
        _member(trial, runs, store, accept_versions, **own)
        for trial, own in zip(trials, options, strict=True)
    ]
    return Lockstep().run(members)


def check(trials: Sequence[Trial]) -> None:
    """Raise UserError unless all train online in one environment on a device that there is."""
    if len({trial.env for trial in trials}) > 1:
        raise UserError("a fleet shares one environment: train the others with another command")
    for trial in trials:
        if not isinstance(trial.config, OnlineConfig):
            raise UserError(
                f"{trial.env} trains alone, on the CPU: leave out --engine fleet and --device"
            )
        require_device(trial.config.device)


def _member(
    trial: Trial,
    runs: Sequence[RunReader],
    store: Store,
    accept_versions: bool,
    **options: Unpack[RecordingOptions],
) -> Recorded:
    """The training of one member: new, from its checkpoint, or nothing where it is finished."""
    found = same_run(trial, runs)
    if found is not None and found.status.state == "finished":
        return _finished(found)
    begun = unfinished(store, trial.config)
    if begun is not None:
        return resumed(store, begun, accept_versions=accept_versions, **options)
    return recorded(trial.config, store, None if found else trial.run_id, **options)


def _finished(run: RunReader) -> Recorded:
    yield from ()
    return run
