"""Properties of small copies (written by `thin`): `thinned` in `config.json`, and the status."""

import shlex
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tom.record.status import Status

KEY = "thinned"
NAME = "a small copy"
PLACES = ("--store", "--out")
"""options whose values are folders of the machine that made the run"""


def is_one(config: Mapping[str, Any]) -> bool:
    """Whether it is the configuration of a small copy."""
    return KEY in config


def left_out(config: Mapping[str, Any]) -> tuple[str, ...]:
    """The parts of the run that its small copy lacks; of `other ...` it has some."""
    return tuple(config.get(KEY, {}).get("left_out", ()))


def shown(status: Status, small: bool) -> str:
    """The state in words: `finished`, or `finished (a small copy)`."""
    return f"{status.shown} ({NAME})" if small else status.shown


def status_of(run: Status, env_step: int) -> Status:
    """The status of a copy at `env_step` of a run that has not ended: the copy cannot go on."""
    if run.state == "stopped":
        why = "where it was stopped"
    else:
        why = "while it was training" if run.alive else "after its process ended without a word"
    reason = f"copied at step {env_step} {why}"
    return replace(run, state="stopped", phase="", env_step=env_step, reason=reason, eta_s=None)


def described(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a run without the folders of its machine: a copy is made to share."""
    told = _placeless(config)
    if config.get("resumes"):
        told["resumes"] = [_placeless(resume) for resume in config["resumes"]]
    return told


def _placeless(made: Mapping[str, Any]) -> dict[str, Any]:
    command = {"command": _without_places(str(made["command"]))} if "command" in made else {}
    return {**made, **command}


def _without_places(command: str) -> str:
    kept, place = [], False
    for word in shlex.split(command):
        name, given, _ = word.partition("=")
        if name in PLACES:
            place = not given  # else the value is the next word
        elif place:
            place = False
        else:
            kept.append(word)
    return shlex.join(kept)
