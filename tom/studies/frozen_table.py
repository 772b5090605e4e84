"""The outcomes of a frozen-buffer study as the table beside its report (`moments.csv`)."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from tom.errors import UserError
from tom.reports.files import write_csv
from tom.studies.frozen import ModelError, Outcome

ERROR, ROLLOUT_ERROR = "error ", "rollout error "
"""the beginnings of the columns of a model's errors"""


def write_outcomes(path: Path, outcomes: Sequence[Outcome]) -> None:
    """One line for each outcome, with two columns for each model."""
    write_csv(path, [_flat(one) for one in outcomes])


def read_outcomes(path: Path, models: bool) -> list[Outcome]:
    """The outcomes of a table written by `write_outcomes`, to the bit.

    Raises UserError if `path` cannot be read, is no such table, or lacks the errors of `models`.
    """
    try:
        with path.open(newline="") as file:
            outcomes = [_outcome(line) for line in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise UserError(f"{path} is no moments.csv of this study ({error})") from error
    if not outcomes or not all(bool(one.errors) >= models for one in outcomes):
        raise UserError(f"{path} has no outcome of this study: name the moments.csv of its report")
    return outcomes


def _flat(one: Outcome) -> dict[str, Any]:
    row = asdict(one)
    for error in row.pop("errors"):
        row[ERROR + error["model"]] = error["error"]
        row[ROLLOUT_ERROR + error["model"]] = error["rollout_error"]
    return row


def _outcome(line: Mapping[str, str]) -> Outcome:
    plain = {
        field.name: field.type(line[field.name])  # pyright: ignore[reportCallIssue]
        for field in fields(Outcome)
        if field.name != "errors"
    }
    models = [name.removeprefix(ERROR) for name in line if name.startswith(ERROR)]
    errors = [
        ModelError(name, float(line[ERROR + name]), float(line[ROLLOUT_ERROR + name]))
        for name in models
    ]
    return Outcome(**plain, errors=tuple(errors))
