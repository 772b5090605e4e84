"""The plan of a sweep: every environment with every learner and seed, and the run of each."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError
from ruamel.yaml import YAML, YAMLError

from tom.config import Config, OnlineConfig, RoadConfig, RunConfig
from tom.errors import UserError, invalid_value, reason
from tom.readable import flat
from tom.record import RunReader
from tom.record.layout import run_name
from tom.training.presets import default_preset, resolve

Seed = Annotated[int, Field(ge=0)]


class Plan(Config):
    """The content of a sweep's YAML file."""

    env: Annotated[list[str], Field(min_length=1)]
    learner: Annotated[list[str], Field(min_length=1)]
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)] = (0,)
    steps: Annotated[int, Field(ge=1)] | None = None
    preset: str | None = None
    """without one that of `default_preset`, for each learner its own"""
    settings: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True)
class Trial:
    """One training of a sweep: `overrides` of the preset, as nested dicts."""

    env: str
    learner: str
    seed: int
    preset: str
    overrides: dict[str, Any]

    @cached_property
    def config(self) -> OnlineConfig | RoadConfig:
        """Its whole configuration. Raises UserError or ValidationError if it is impossible."""
        return resolve(self.env, self.learner, self.preset, {**self.overrides, "seed": self.seed})

    @cached_property
    def run_id(self) -> str:
        """Depends only on the settings, so that a repeated sweep finds the run again."""
        text = json.dumps(self.config.model_dump(mode="json"), sort_keys=True).encode()
        digest = hashlib.sha256(text).hexdigest()[:8]
        return run_name(self.env, self.learner, self.seed, digest)

    def options(self) -> tuple[str, ...]:
        """The options of `tom train` for this training."""
        given = {"env": self.env, "learner": self.learner, "preset": self.preset}
        values = given | {"seed": self.seed} | flat(self.overrides)
        texts = {
            name: str(value).lower() if value is None or isinstance(value, bool) else str(value)
            for name, value in values.items()
        }
        return tuple(f"--{name.replace('_', '-')}={text}" for name, text in texts.items())


def trials(plan: Plan) -> list[Trial]:
    """Every training of the plan without duplicates; the first seed of all before the second.

    Raises UserError that names the first impossible one.
    """
    overrides = plan.settings | ({} if plan.steps is None else {"steps": plan.steps})
    fixed = {"env", "learner", "seed", "preset"} & set(overrides)
    if fixed:
        raise UserError(f"settings.{min(fixed)}: name it outside of the settings")
    every = [
        Trial(env, learner, seed, plan.preset or default_preset(env, learner), overrides)
        for seed in dict.fromkeys(plan.seeds)
        for env in dict.fromkeys(plan.env)
        for learner in dict.fromkeys(plan.learner)
    ]
    for trial in every:
        try:
            _ = trial.config
        except ValidationError as error:
            raise UserError(f"{trial.env} {trial.learner}: {invalid_value(error)}") from None
    return every


def read_plan(path: Path) -> dict[str, Any]:
    """The unchecked mapping in a YAML file. Raises UserError if it is not such a file."""
    try:
        content = YAML(typ="safe", pure=True).load(path.read_bytes())
    except (OSError, YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or reason(error)
        raise UserError(f"cannot read {path}{line}: {problem}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path} is not a mapping: write `env: [hopper]` and so on")
    return content


def checked(content: dict[str, Any]) -> Plan:
    """The plan in a mapping. Raises UserError that names the first error."""
    lists = ("env", "learner", "seeds")
    single = {name: [content[name]] for name in lists if isinstance(content.get(name), str | int)}
    try:
        return Plan.model_validate({**content, **single})
    except ValidationError as error:
        known = ", ".join(Plan.model_fields)
        raise UserError(f"sweep: {invalid_value(error)} (a plan has {known})") from None


def same_run(trial: Trial, runs: Sequence[RunReader]) -> RunReader | None:
    """The run of this training among `runs`: a finished one, else its own, else the newest.

    A small copy is used only if there is no whole run of that kind, and its own run that was given
    other steps only if there is none of just these steps.
    """
    beyond = {run.path: steps_beyond(trial.config, run) for run in runs}
    mine = [run for run in runs if beyond[run.path] == 0]
    mine.sort(
        key=lambda run: (
            run.status.state != "finished",
            run.small_copy,
            run.run_id != trial.run_id,
        )
    )
    other_steps = [run for run in runs if run.run_id == trial.run_id and beyond[run.path]]
    return next(iter([*mine, *other_steps]), None)


def is_done(config: RunConfig, run: RunReader) -> bool:
    """Whether the run has all steps of this training: up to them a longer one is the same."""
    beyond, status = steps_beyond(config, run), run.status
    if beyond is None:
        return False
    reached = beyond > 0 and status.env_step >= config.total_steps
    return reached or (beyond >= 0 and status.state == "finished")


def steps_beyond(config: RunConfig, run: RunReader) -> int | None:
    """How many more steps than this training the run was given; None if it is another training.

    The halves of a recording of SAC depend on its steps.
    """
    given, planned = run.given, config.model_dump(mode="json")
    if "steps" not in given:
        return None  # damaged
    same = {**given, "steps": planned["steps"]} == planned if run.fits_model else given == planned
    return given["steps"] - planned["steps"] if same else None
