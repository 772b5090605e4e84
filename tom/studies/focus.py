"""Does weighting improve the model where the policy goes? One buffer, one policy, several learners.

Each learner weighs the replay buffer of a SAC recording (random half, ordered half) for SAC's final
policy. The paper's model is fitted with those weights from new initial parameters. Its error is
measured on fresh transitions of the policy, and on the two halves of the buffer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import torch
from torch import Tensor

from tom.analysis.ordered_data import OrderedData, of_run
from tom.analysis.weighing import Weighed, weigh
from tom.config import OnlineConfig, TomConfig
from tom.data.sampling import ess, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.dynamics.base import DynamicsModel
from tom.envs import Task, task
from tom.exams.diagnostics import ROWS, one_step_error, rollout_error, step_scale, unbroken
from tom.learners import LEARNERS
from tom.learners.base import Policy, Weighting
from tom.policy.collect import footprint
from tom.policy.stored import NAME, read_policy
from tom.record import RunReader
from tom.rng import Streams
from tom.training.presets import PRESETS, resolve

Rival = Literal["mle", "pmac", "tom paper", "tom mended", "tom exact"]
RIVALS: tuple[Rival, ...] = ("mle", "pmac", "tom paper", "tom mended", "tom exact")
"""the learners compared, TOM as printed, mended, and with the preset of `TomConfig`"""


@dataclass(frozen=True)
class Focus:
    """The errors of one learner's model, in standard deviations of a step's change."""

    recording: str
    rival: Rival
    seed: int
    ess: float  # effective sample size of the weights, share of the buffer
    policy: float  # one step, fresh transitions of the policy
    policy_rollout: float  # five steps under the policy's actions, from its states
    ordered: float  # one step, uniform rows of the buffer's ordered half
    random: float  # one step, uniform rows of the random half


QUANTITIES = {
    "policy": "the policy's own, anew",
    "policy_rollout": "the same, 5 steps",
    "ordered": "the buffer's ordered half",
    "random": "the buffer's random half",
}
"""the errors of a `Focus` and the data on which they are measured"""


@dataclass(frozen=True)
class Case:
    """One learner under one seed on one recording, with the model of a run's `preset`.

    A seed draws the footprint for TOM, the networks, the minibatches and the test transitions. Only
    the policy's fresh transitions are new to every learner; the models were fitted to those of the
    buffer's two halves, except the held-out ones.
    """

    recording: Path
    rival: Rival
    seed: int
    preset: str = "paper"
    made: str = ""  # time of creation: a new recording under the same path is another case


def cases(
    runs: Sequence[RunReader], seeds: Sequence[int], rivals: Sequence[Rival] = RIVALS
) -> list[Case]:
    """Every rival with every seed on every recording."""
    return [
        Case(run.path, rival, seed, made=run.created)
        for run in runs
        for seed in seeds
        for rival in rivals
    ]


def focus(case: Case) -> Focus:
    """Weigh, fit and test one case."""
    run = RunReader(case.recording)
    data, policy, known = of_run(run), read_policy(run.path / NAME), task(run.env)
    config = _config(run.env, case.rival, case.preset).but(seed=case.seed)
    (weighed,) = weigh(data, policy, known, config, (config.learner,), (case.seed,))
    errors = _errors(_fitted(data, weighed, config), _tested(data, policy, known, case.seed))
    of_weights = ess(torch.from_numpy(weighed.weights))
    return Focus(f"{run.env}-s{run.seed}", case.rival, case.seed, of_weights, *errors)


def summary(results: Sequence[Focus]) -> list[dict[str, str | float]]:
    """Medians over seeds, one row per recording and rival, with errors relative to MLE's."""
    rows: list[dict[str, str | float]] = []
    for recording in dict.fromkeys(f.recording for f in results):
        here = [f for f in results if f.recording == recording]
        for rival in dict.fromkeys(f.rival for f in here):
            of = [f for f in here if f.rival == rival]
            row: dict[str, str | float] = {"recording": recording, "rival": rival}
            row["ess"] = median(f.ess for f in of)
            for quantity in QUANTITIES:
                row[quantity] = median(getattr(f, quantity) for f in of)
                row[f"{quantity} / mle"] = _ratio(of, here, quantity)
            rows.append(row)
    return rows


def verdict(results: Sequence[Focus]) -> list[str]:
    """For each learner except MLE: where its model is better than MLE's, and whether as claimed."""
    rivals = dict.fromkeys(f.rival for f in results if f.rival != "mle")
    return [_verdict(results, rival) for rival in rivals]


def _verdict(results: Sequence[Focus], rival: str) -> str:
    mle = {(f.recording, f.seed): f for f in results if f.rival == "mle"}
    pairs = [(f, mle[f.recording, f.seed]) for f in results if f.rival == rival]
    ratios = {q: [getattr(f, q) / getattr(m, q) for f, m in pairs] for q in QUANTITIES}
    told = (
        f"{QUANTITIES[q]} {median(of):.2f} (less in {sum(r < 1 for r in of)} of {len(of)})"
        for q, of in ratios.items()
    )
    name, _, preset = rival.partition(" ")
    label = LEARNERS[name].label + (f" ({preset} preset)" if preset else "")
    line = f"{label}: error over MLE's under the same seed, median: {', '.join(told)}."
    if name != "tom":
        return line
    where = [q for q in ("policy", "policy_rollout") if median(ratios[q]) < 1]
    says = {2: "as claimed", 1: "as claimed over one of the two lengths only", 0: "not as claimed"}
    return f"{line} Where the policy goes: {says[len(where)]}."


def _ratio(of: Sequence[Focus], here: Sequence[Focus], quantity: str) -> float:
    """Median over seeds of the error relative to MLE's with the same seed; NaN without MLE."""
    mle = {f.seed: getattr(f, quantity) for f in here if f.rival == "mle"}
    ratios = [getattr(f, quantity) / mle[f.seed] for f in of if f.seed in mle]
    return median(ratios) if ratios else float("nan")


@dataclass(frozen=True)
class _Tested:
    """The test data of all models of one seed."""

    policy: TensorTransitions
    ordered: TensorTransitions
    random: TensorTransitions
    scale: Tensor  # (O,)


def _tested(data: OrderedData, policy: Policy, known: Task, seed: int) -> _Tested:
    streams, rows, first = Streams(seed), data.transitions, data.ordered_from
    generator = streams.torch("focus")
    anew = footprint(known, policy, ROWS, streams.integer("focus env"), generator)
    ordered = first + uniform_indices(len(rows) - first, ROWS, generator)
    random = uniform_indices(first, ROWS, generator)
    return _Tested(anew.transitions.torch(), rows[ordered], rows[random], step_scale(rows))


def _config(env: str, rival: Rival, preset: str) -> OnlineConfig:
    learner, _, of_tom = rival.partition(" ")
    config = resolve(env, learner, preset)
    assert isinstance(config, OnlineConfig)
    return config.but(tom=_objective(of_tom).model_dump())


def _objective(name: str) -> TomConfig:
    if name == "mended":
        return TomConfig.model_validate(PRESETS[name]["tom"])
    return TomConfig.preset("exact" if name == "exact" else "paper")


def _fitted(data: OrderedData, weighed: Weighed, config: OnlineConfig) -> DynamicsModel:
    rows, streams = data.transitions, Streams(config.seed)
    dims = rows.obs.shape[1], rows.action.shape[1]
    model = make_model(*dims, config.model, streams.torch("model"))
    clipped = LEARNERS[config.learner].clipped
    weighting = Weighting(torch.from_numpy(weighed.weights), clipped=clipped)
    model.fit(rows, *weighting.for_fit(config.model), streams.torch("fit"))
    return model


def _errors(model: DynamicsModel, tested: _Tested) -> tuple[float, float, float, float]:
    """The errors of a `Focus`, in its order."""
    scale, starts = tested.scale, unbroken(tested.policy)
    return (
        one_step_error(model, tested.policy, scale),
        rollout_error(model, tested.policy, starts, scale),
        one_step_error(model, tested.ordered, scale),
        one_step_error(model, tested.random, scale),
    )
