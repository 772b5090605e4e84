"""Checks that a resumed run has the versions and settings of its checkpoint."""

from collections.abc import Mapping
from typing import Any

from tom.config import RunConfig, flat
from tom.errors import StartAgainError, UserError
from tom.mbpo import Mbpo
from tom.record import RunReader
from tom.record.checkpoint import Checkpoint
from tom.record.versions import ACCEPT, decides, versions


def check_versions(reader: RunReader, accepted: bool) -> str:
    """A warning about versions that differ from those of the run's last training, or "".

    Raises UserError if its results would change, unless `accepted`.
    """
    before, now = _last_versions(reader), versions()
    changed = [name for name in now if before.get(name, now[name]) != now[name]]
    said = {name: f"{name} {before[name]} then, {now[name]} now" for name in changed}
    decisive = [said[name] for name in changed if decides(name, str(before[name]), now[name])]
    if decisive and not accepted:
        raise UserError(
            f"run '{reader.run_id}' was trained with other versions ({', '.join(decisive)}), and "
            f"its results would change: {ACCEPT} goes on with these, or start it again"
        )
    return f"trained with other versions until here: {', '.join(said.values())}" if said else ""


def check_training(reader: RunReader, held: Checkpoint, config: RunConfig, training: object) -> str:
    """A warning about settings other than the steps that changed since the checkpoint, or "".

    Raises UserError for a checkpoint of another learner or environment.
    """
    now = config.model_dump(mode="json")
    before = held.state.get("config")
    if not isinstance(before, Mapping):  # from an earlier version
        if _other_learner(held, training):
            raise _another(reader, held, f"another learner than {config.learner}")
        return ""
    for name in ("learner", "env"):
        if before.get(name) != now[name]:
            raise _another(reader, held, f"{name} {before.get(name)}, not {now[name]}")
    old, new = flat(before), flat(now)
    changed = [name for name in new if name != "steps" and old.get(name, new[name]) != new[name]]
    if not changed:
        return ""
    listed = ", ".join(f"{name} ({old[name]}, now {new[name]})" for name in changed)
    return f"settings were changed since the checkpoint: {listed}; results may differ"


def _last_versions(reader: RunReader) -> Mapping[str, Any]:
    """The versions of the run's last training; empty if they are not recorded."""
    resumes = reader.config.get("resumes")
    entries = [reader.config, *(resumes if isinstance(resumes, list) else [])]
    said = [entry.get("versions") for entry in entries if isinstance(entry, dict)]
    return next((each for each in reversed(said) if isinstance(each, dict)), {})


def _other_learner(held: Checkpoint, training: object) -> bool:
    """Whether the learner's state in the checkpoint has other parts than this learner's."""
    state = held.state.get("training")
    if not isinstance(training, Mbpo) or not isinstance(state, Mapping):
        return False
    return set(state.get("learner", ())) != set(training.learner.state_dict())


def _another(reader: RunReader, held: Checkpoint, what: str) -> StartAgainError:
    return StartAgainError(
        f"the checkpoint of run '{reader.run_id}' at step {held.env_step} is of {what}: put back "
        "its config.json, or start it again"
    )
