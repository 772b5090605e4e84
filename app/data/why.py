"""Why a transition has its weight, for the pages: the terms, and the nearest transitions."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app import text
from app.data import readers
from app.data.buffer import Floats, Rows
from app.data.cache import VersionedCache
from app.data.readers import RunInfo
from app.data.weighings import WeighingInfo
from tom.analysis import why
from tom.analysis.imagine import stored_model
from tom.analysis.weighing import load_policy, made_anew
from tom.analysis.why import Near, Sum
from tom.config import OnlineConfig, RolloutConfig, RunConfig, TomConfig
from tom.data.transitions import TensorTransitions, Transitions
from tom.data.unpack import DAMAGE
from tom.dynamics.neural import NeuralDynamics
from tom.envs import ENVS, task
from tom.errors import UserError
from tom.learners import LEARNERS, WITH_TERMS
from tom.learners.terms import Terms, of_recorded
from tom.record import stamps
from tom.record.decode import read_table
from tom.record.files import read_json
from tom.record.reader import RunReader
from tom.record.store import Store
from tom.reports.weighing_files import REPORT, WEIGHTS
from tom.training.resume import recorded_config

NEAREST = 5
JUDGED = 500
"""number of rows from which the usual distance to the policy's rows is estimated"""
ROLLOUTS, STEPS = 24, 10
DIMENSIONS = "per-dimension weights"
"""their name among the parts that a small copy left out"""


@dataclass(frozen=True)
class Source:
    """The terms of N weights, the settings of their computation, and the policy's own rows."""

    terms: Terms
    config: TomConfig
    whose: str
    policy_rows: TensorTransitions  # (M,) the discriminator's rows of the policy
    among: Tensor  # (M,) the rows of the buffer that these are; (0,) if they were made anew
    step: int | None  # of the fit or weighing; None: all that the run collected

    def sum_of(self, row: int) -> Sum:
        """The terms of a row."""
        return why.sum_of(self.terms, self.config, row)


@dataclass(frozen=True)
class Neighbours:
    """The policy's transitions nearest to a row, and the usual distances for comparison."""

    near: Near
    rows: Transitions  # (K,) those transitions
    usual: float  # median over rows of the buffer that are not the policy's own
    own: float  # median over the policy's own rows


def source(run: RunInfo, rows: Rows, weighings: list[WeighingInfo]) -> Source | str:
    """The terms of these weights, or a text with the reason why there are none."""
    key = run.path, rows.first, rows.weight.tobytes(), tuple(w.written for w in weighings)
    return _SOURCES.get(key, lambda: _source(run, rows, weighings))


def neighbours(rows: Rows, source: Source, row: int) -> Neighbours:
    """The policy's transitions nearest to a row of the buffer, but for the row itself."""
    replay, policy_rows = rows.rows.torch(), source.policy_rows
    here = (source.among == row).nonzero().flatten().tolist() if len(policy_rows) > 1 else []
    near = why.nearest(replay, row, policy_rows, NEAREST, itself=here[0] if here else None)
    own = _between(replay, policy_rows, len(policy_rows) // 2)
    usual = _usual(replay, source, own)
    return Neighbours(near, policy_rows[near.index].numpy(), usual, own)


def starts(run: RunInfo, rows: Rows, row: int) -> tuple[float, float] | str:
    """The expected number of a fit's rollouts that start in a row, or why it is unknown.

    Beside it that of a row of weight 1.
    """
    settings = _rollout_settings(run)
    if settings is None:
        return "the settings of this run's rollouts are those of another version"
    # Weights of dimensions scale the loss, and draw nothing.
    weight = np.ones_like(rows.weight) if _weighs_dimensions(run) else rows.weight
    begun = why.expected_starts(torch.from_numpy(weight), row, settings)
    return begun, settings.starts / len(rows)


@dataclass(frozen=True)
class Rollouts:
    """Rollouts of a policy in the stored model."""

    paths: Floats  # (ROLLOUTS, STEPS + 1, O)
    model_step: int
    own: bool  # whether the policy is that of the step that was asked for, not the run's last


def rollouts(run: RunInfo, rows: Rows, row: int, step: int) -> Rollouts | str:
    """Rollouts from a row by the policy of `step`, or by the run's last if that was not kept.

    A text with the reason if there are none.
    """
    reader = readers.reader(run)
    stored = stamps.model(reader.path), stamps.policies(reader.path, step)
    version = *stored, reader.has_policy()
    key = run.path, rows.first + row, step, version
    return _ROLLOUTS.get(key, lambda: _rollouts(run, reader, rows, row, step))


def recorded_after(rows: Rows, row: int) -> NDArray[np.float32]:
    """The recorded observations (T + 1, O) from a row on, T at most STEPS."""
    last = row
    whole = rows.rows
    ended = whole.ended()
    while last - row + 1 < STEPS and last + 1 < len(rows) and not ended[last]:
        last += 1
    obs, following = np.asarray(whole.obs), np.asarray(whole.next_obs)
    return np.concatenate([obs[row : last + 1], following[last : last + 1]])


_SOURCES: VersionedCache[Source | str] = VersionedCache()
_ROLLOUTS: VersionedCache[Rollouts | str] = VersionedCache()


def _source(run: RunInfo, rows: Rows, weighings: list[WeighingInfo]) -> Source | str:
    reader = readers.reader(run)
    whose_sum = " and ".join(f"{LEARNERS[name].label}'s" for name in WITH_TERMS)
    without = "no learner's file holds these weights: a brush changed them, or the file has changed"
    for table, weight, named in candidates(reader, weighings):
        if len(table[weight]) != len(rows) or not np.array_equal(table[weight], rows.weight):
            continue
        learner, made = named
        if learner not in WITH_TERMS:
            return f"only {whose_sum} weights are such a sum, and these are of {learner}"
        try:
            config, whose, policy_rows, among, step = _made_by(run, reader, rows, weight, made)
        except (UserError, OSError, ValueError, KeyError) as error:
            return str(error)
        prefix = "" if made is None else f"{weight}-"
        terms = of_recorded(
            {n: torch.tensor(table[prefix + n]) for n in Terms.named() if prefix + n in table}
        )
        if terms is not None:
            return Source(terms, config, whose, policy_rows, among, step)
        if np.ptp(rows.weight) == 0:
            return f"{LEARNERS[learner].label} did not weigh here: all count the same"
        without = (
            "its terms were not kept; runs trained with this version have them, and small copies "
            "of such runs with their buffer, but not the gallery nor small copies of weighings"
        )
    return without


def candidates(
    reader: RunReader, weighings: list[WeighingInfo]
) -> Iterator[tuple[dict[str, NDArray], str, tuple[str, WeighingInfo | None]]]:
    """Columns, the name of the weights' column, and their source."""
    for step in reader.snapshot_steps():
        frame = reader.snapshot(step)
        yield {n: frame[n].to_numpy() for n in frame}, "weight", (reader.learner, None)
    for made in weighings:
        try:
            frame = read_table(Path(made.path) / WEIGHTS)
        except DAMAGE:
            continue
        table = {str(n): np.array(frame[n]) for n in frame}
        for name in table:
            learner, _, seed = name.rpartition("-s")
            if text.whole(seed) is not None:
                yield table, name, (learner, made)


def _made_by(
    run: RunInfo, reader: RunReader, rows: Rows, weight: str, made: WeighingInfo | None
) -> tuple[TomConfig, str, TensorTransitions, Tensor, int | None]:
    if made is None:
        config = recorded_config(reader)
        tom: TomConfig = config.tom  # pyright: ignore[reportAttributeAccessIssue]
        among, end = _policy_rows(config, reader, rows), rows.first + len(rows)
        return tom, "the run's own fit", rows.rows.torch()[among], among, end
    report = read_json(Path(made.path) / REPORT)
    tom = TomConfig.model_validate(report["config"]["tom"])
    known, store = task(run.env), Store(Path(run.path).parent)
    policy = load_policy(made.policy, store, known, made.step)
    seed = int(weight.rpartition("-s")[2])
    policy_rows = made_anew(known, policy, int(report["footprint"]), seed).transitions.torch()
    return tom, f"the weighing {made.name}", policy_rows, torch.arange(0), made.step


def _policy_rows(config: RunConfig, reader: RunReader, rows: Rows) -> Tensor:
    """The rows (M,) of the buffer that were the policy's in a run's own fit."""
    if isinstance(config, OnlineConfig):
        taken = max(rows.first + len(rows) - config.exploration_steps, 0)
        newest = min(taken, config.policy_capacity, len(rows))
        return torch.arange(len(rows) - newest, len(rows))
    shown = reader.field("data", 0).get("footprint")
    if shown is None:
        raise UserError("which of its rows are the policy's was not kept")
    return torch.from_numpy(np.flatnonzero(shown))


def _usual(replay: TensorTransitions, source: Source, own: float) -> float:
    """The median distance of the buffer's other rows to the policy's; `own` if it has no others."""
    other = torch.ones(len(replay), dtype=torch.bool)
    other[source.among] = False
    others = other.nonzero().flatten()
    if not len(others):
        return own
    judged = torch.linspace(0, len(others) - 1, min(JUDGED, len(others))).long()
    return why.usual_distance(replay, source.policy_rows, others[judged])


def _between(replay: TensorTransitions, policy_rows: TensorTransitions, half: int) -> float:
    """The median distance of one half of the policy's rows to the other half."""
    if not half:
        return float("nan")
    joined = TensorTransitions.join([replay, policy_rows[:half]])
    # In the scale of the buffer, which few rows hardly change.
    return why.usual_distance(joined, policy_rows[half:], torch.arange(len(replay), len(joined)))


def _weighs_dimensions(run: RunInfo) -> bool:
    """Whether the run's learner weighs the dimensions of each transition; copies leave them out."""
    reader = readers.reader(run)
    steps = reversed(reader.snapshot_steps())
    return DIMENSIONS in reader.left_out or any("dim_0" in reader.snapshot(step) for step in steps)


def _rollout_settings(run: RunInfo) -> RolloutConfig | None:
    try:
        return getattr(recorded_config(readers.reader(run)), "rollout", None)
    except UserError:
        return None


def _rollouts(run: RunInfo, reader: RunReader, rows: Rows, row: int, step: int) -> Rollouts | str:
    if run.env not in ENVS:
        return f"they are drawn for the built-in tasks, and {run.env} is none of them"
    try:
        known, kept = task(run.env), stored_model(reader)
        policy_step = step if reader.has_policy(step) else None
        if not reader.has_policy(policy_step):
            return "the policy of this fit was not kept, and the run has no last one"
        policy = load_policy(run.path, Store(Path(run.path).parent), known, policy_step)
    except UserError as error:
        return str(error)
    if not isinstance(kept.predictor, NeuralDynamics):
        return "its model draws no samples"
    start = torch.as_tensor(np.asarray(rows.rows.obs)[row])
    generator = torch.Generator().manual_seed(0)
    paths = why.rollouts(
        kept.predictor, policy, known.terminated, start, STEPS, ROLLOUTS, generator
    )
    own = policy_step is not None or step == reader.buffer_length()
    return Rollouts(paths.numpy().astype(np.float64), kept.env_step, own)
