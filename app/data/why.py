"""Why a transition has its weight, for the pages: the terms, and the nearest transitions."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.data import buffer
from app.data.buffer import Floats, Rows
from app.data.buffer_map import Source
from app.data.cache import cached
from app.data.readers import fresh_reader
from app.data.weighings import Weighing
from tom.analysis import why
from tom.analysis.weighing import collect_footprint, load_policy
from tom.analysis.why import Near, Sum
from tom.config import OnlineConfig, TomConfig
from tom.data.transitions import TensorTransitions, Transitions
from tom.dynamics.neural import NeuralDynamics
from tom.envs import ENVS, task
from tom.errors import UserError
from tom.learners import LEARNERS, WITH_TERMS
from tom.learners.terms import Terms, of_recorded
from tom.policy.foreign import ONNX, is_foreign
from tom.record.reader import RunReader
from tom.record.store import Store
from tom.reports.weighing_files import is_brush
from tom.training.resume import recorded_config

NEAREST = 5
SAMPLED_ROWS = 500
"""number of rows from which the usual distance to the policy's rows is estimated"""
ROLLOUTS, STEPS = 24, 10
DIMENSIONS = "per-dimension weights"
"""their name among the parts that a small copy left out"""


@dataclass(frozen=True)
class Why:
    """The terms of N weights, the settings of their computation, and the policy's own rows."""

    terms: Terms
    config: TomConfig
    origin: str
    policy_rows: TensorTransitions  # (M,) the discriminator's rows of the policy; (0,) if not known
    buffer_rows: Tensor  # (M,) the rows of the buffer that these are; (0,) if they were made anew

    def sum_of(self, row: int) -> Sum:
        """The terms of a row."""
        return why.sum_of(self.terms, self.config, row)


@cached("buffer", "pictures")
def why_of(run: RunReader, source: Source) -> Why | str:
    """The terms of these weights, or a text with the reason why there are none."""
    weighing, learner = source.weighing, source.learner
    if weighing is not None and is_brush(weighing.report):
        return "no learner made these weights: a brush changed them"
    if learner not in WITH_TERMS:
        whose = " and ".join(f"{LEARNERS[name].label}'s" for name in WITH_TERMS)
        return f"only {whose} weights are such a sum, and these are those of {learner}"
    prefix = "" if weighing is None else f"{source.column}-"
    table = fresh_reader(run).snapshot(int(source.label)) if weighing is None else weighing.table()
    names = [name for name in Terms.named() if prefix + name in table]
    terms = of_recorded({name: torch.tensor(np.array(table[prefix + name])) for name in names})
    if terms is not None:
        try:
            context = (
                _fit_context(run, source)
                if weighing is None
                else _weighing_context(run, source, weighing)
            )
            return Why(terms, *context)
        except (UserError, OSError, ValueError, KeyError) as error:
            return str(error)
    if np.ptp(source.weight) == 0:
        return f"{LEARNERS[learner].label} did not weigh here: all count the same"
    return (
        "its terms were not kept. Runs trained with this version have them, and so do their small "
        "copies with a buffer; the gallery and small copies of weighings do not"
    )


def _fit_context(
    run: RunReader, source: Source
) -> tuple[TomConfig, str, TensorTransitions, Tensor]:
    """What belongs to the terms of a run's own fit; the policy's rows are the buffer's newest."""
    config, count = recorded_config(run), len(source.weight)
    if isinstance(config, OnlineConfig):
        taken = max(source.end - config.exploration_steps, 0)
        newest = min(taken, config.policy_capacity, count)
        among = torch.arange(count - newest, count)
    else:
        shown = fresh_reader(run).field("data", 0).get("footprint")
        if shown is None:
            raise UserError("the run did not keep which of its rows are the policy's")
        among = torch.from_numpy(np.flatnonzero(shown))
    tom: TomConfig = config.tom  # pyright: ignore[reportAttributeAccessIssue]
    rows = buffer.recorded(run).rows[source.first : source.end].torch()
    return tom, "the run's own fit", rows[among], among


def _weighing_context(
    run: RunReader, source: Source, weighing: Weighing
) -> tuple[TomConfig, str, TensorTransitions, Tensor]:
    """What belongs to the terms of a weighing; the policy's rows are made anew, but not by code."""
    tom = TomConfig.model_validate(weighing.report["config"]["tom"])
    name = weighing.report["policy"]
    if is_foreign(name) and not name.endswith(ONNX):
        anew = buffer.recorded(run).rows[:0].torch()
    else:
        known, store = task(run.env), Store(weighing.path.parents[1])
        policy = load_policy(name, store, known, weighing.step)
        seed, count = int(source.column.rpartition("-s")[2]), int(weighing.report["footprint"])
        anew = collect_footprint(known, policy, count, seed).transitions.torch()
    return tom, f"the weighing {weighing.name}", anew, torch.arange(0)


@dataclass(frozen=True)
class Neighbours:
    """The policy's transitions nearest to a row, and the usual distances for comparison."""

    near: Near
    rows: Transitions  # (K,) those transitions
    usual: float  # median over rows of the buffer that are not the policy's own
    own: float  # median over the policy's own rows


def neighbours(rows: Rows, found: Why, row: int) -> Neighbours:
    """The policy's transitions nearest to a row of the buffer, but for the row itself."""
    replay, policy_rows = rows.rows.torch(), found.policy_rows
    here = (found.buffer_rows == row).nonzero().flatten().tolist() if len(policy_rows) > 1 else []
    near = why.nearest(replay, row, policy_rows, NEAREST, itself=here[0] if here else None)
    own = usual = float("nan")
    if half := len(policy_rows) // 2:
        joined = TensorTransitions.join([replay, policy_rows[:half]])
        # In the scale of the buffer, which few rows hardly change.
        one_half = torch.arange(len(replay), len(joined))
        own = usual = why.usual_distance(joined, policy_rows[half:], one_half)
    other = torch.ones(len(replay), dtype=torch.bool)
    other[found.buffer_rows] = False
    others = other.nonzero().flatten()
    if len(others):
        judged = torch.linspace(0, len(others) - 1, min(SAMPLED_ROWS, len(others))).long()
        usual = why.usual_distance(replay, policy_rows, others[judged])
    return Neighbours(near, policy_rows[near.index].numpy(), usual, own)


def starts(run: RunReader, rows: Rows, row: int) -> tuple[float, float] | None:
    """The expected number of a fit's rollouts that start in a row, and of one of weight 1.

    None if the settings of the run's rollouts are those of another version.
    """
    try:
        settings = getattr(recorded_config(run), "rollout", None)
    except UserError:
        settings = None
    if settings is None:
        return None
    part = fresh_reader(run)
    # Weights of dimensions scale the loss, and draw nothing.
    weighs_dimensions = DIMENSIONS in run.left_out or any(
        "dim_0" in part.snapshot(step) for step in reversed(part.snapshot_steps())
    )
    weight = np.ones_like(rows.weight) if weighs_dimensions else rows.weight
    expected = why.expected_starts(torch.from_numpy(weight), row, settings)
    return expected, settings.starts / len(rows)


@dataclass(frozen=True)
class Rollouts:
    """Rollouts of a policy in the stored model."""

    paths: Floats  # (ROLLOUTS, STEPS + 1, O)
    model_step: int
    own: bool  # whether the policy is that of the step that was asked for, not the run's last


def rollouts(run: RunReader, rows: Rows, row: int, step: int | None) -> Rollouts | str:
    """Rollouts from a row by the policy of `step`, or by the run's last if that was not kept.

    A text with the reason if there are none.
    """
    policy_step = step if run.has_policy(step) else None
    own = policy_step is not None or rows.first + len(rows) == buffer.length(run)
    if run.env not in ENVS:
        return f"they are drawn only for built-in tasks, and {run.env} is not one"
    if not run.has_policy(policy_step):
        return "neither this fit's policy nor the run's last one was kept"
    return _rollouts(run, rows.first + row, policy_step, own)


@cached("model", "policies", "buffer")
def _rollouts(run: RunReader, row: int, policy_step: int | None, own: bool) -> Rollouts | str:
    known, kept = task(run.env), buffer.stored_model(run)
    if isinstance(kept, str):
        return kept
    try:
        policy = load_policy(str(run.path), Store(run.home.parent), known, policy_step)
    except UserError as error:
        return str(error)
    if not isinstance(kept.predictor, NeuralDynamics):
        return "its model draws no samples"
    start = buffer.recorded(run).rows[row : row + 1].torch().obs[0]
    generator = torch.Generator().manual_seed(0)
    paths = why.rollouts(
        kept.predictor, policy, known.terminated, start, STEPS, ROLLOUTS, generator
    )
    return Rollouts(paths.numpy().astype(np.float64), kept.env_step, own)


def recorded_after(rows: Rows, row: int) -> NDArray[np.float32]:
    """The recorded observations (T + 1, O) from a row on, T at most STEPS."""
    ends = np.flatnonzero(rows.rows.ended()[row : row + STEPS])
    after = slice(row, row + int(ends[0]) + 1 if len(ends) else row + STEPS)
    obs, following = np.asarray(rows.rows.obs)[after], np.asarray(rows.rows.next_obs)[after]
    return np.concatenate([obs, following[-1:]])
