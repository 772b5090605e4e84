"""Many trainings of one environment in one process: learners and seeds in lock-step.

Each member is an ordinary run with its own random streams, buffers, environment and run folder. In
a fleet their networks are stacked and stepped as one (see `lockstep`), which makes use of a GPU. On
a CPU it brings nothing, and seeds are processes there.
"""

from collections.abc import Sequence
from functools import partial
from typing import Unpack

from tom.config import OnlineConfig
from tom.errors import UserError
from tom.machine.device import require_device
from tom.nn.lockstep import Lockstep
from tom.record import RunReader, Store, manage
from tom.training.plan import Trial, given_more, is_done, same_run
from tom.training.resume import resume, unfinished
from tom.training.run import Consumer, RecordingOptions, Stop, train


def train_fleet(
    trials: Sequence[Trial],
    store: Store,
    rerun: bool = True,
    watchers: Sequence[Sequence[Consumer]] = (),
    command: str = "",
    stop: Stop | None = None,
    accept_versions: bool = False,
) -> list[RunReader | Exception]:
    """Train all trials, unfinished ones in the store from their checkpoints.

    Returns each trial's run, or the error that ended it. `watchers` has a list for each trial;
    `accept_versions` as in `resume`. Raises UserError if they cannot form a fleet.
    """
    check(trials)
    watching = watchers or [()] * len(trials)
    runs = store.runs()
    options = [
        RecordingOptions(rerun=rerun, watchers=own, command=command, stop=stop) for own in watching
    ]
    members = [
        partial(_member, trial, runs, store, accept_versions, **own)
        for trial, own in zip(trials, options, strict=True)
    ]
    return Lockstep().run(members)


def check(trials: Sequence[Trial]) -> None:
    """Raises UserError unless all train online in one environment on an existing device."""
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
) -> RunReader:
    """Train one member from the start or from its checkpoint, unless it is finished."""
    existing = same_run(trial, runs)
    if existing is not None and is_done(trial, existing):
        return existing
    begun = unfinished(store, trial.config, shorter=False)
    if begun is not None:
        return resume(store, begun, accept_versions=accept_versions, **options)
    return train(trial.config, store, _free_id(trial, existing, store), **options)


def _free_id(trial: Trial, existing: RunReader | None, store: Store) -> str | None:
    """The trial's own run id, where a run that cannot go on goes to the trash.

    None, for a new one, if that run was given more steps. Raises UserError if another process is
    writing the trial's run.
    """
    if existing is None:
        return trial.run_id
    if given_more(trial, existing):
        return None
    if existing.run_id == trial.run_id:
        manage.trash(store, existing.run_id)
    else:
        with manage.unwritten(existing):
            pass
    return trial.run_id
