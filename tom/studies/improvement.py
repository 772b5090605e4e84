"""Do weights make better policies: those in the model, and those in the rollouts' starts?

At a moment of a frozen buffer (`tom.studies.frozen`), soft actor-critic continues from the stored
policy and critics, on rollouts in a model fitted to this buffer. A learner's weights act in two
places: the fit of the model (Algorithm 2, lines 15-18) and the start states of its rollouts (line
22). So every way of weighing is tried in the model only, in the starts only, and in both, with the
same random numbers each time. Whole runs would also differ in data, and take hours.

It differs from a training: the networks of the model are new, so are SAC's optimisers and target
critics, all modelled rows come from this one model (a training keeps those of four fits), and
settings other than SAC's are those of the `paper` preset, as for the other studies of moments.
What ends a modelled episode is the rule of the run; if it has none, a head fitted to the whole
buffer, unweighted. Runs must be whole, or small copies made with --keep buffer policies.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from math import isfinite, nan
from statistics import mean, median
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from tom.analysis.curves import curve_points
from tom.config import OnlineConfig, SacConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions
from tom.dynamics import DynamicsModel
from tom.dynamics.ending import EndingHead
from tom.envs import Termination, task
from tom.envs.termination import learns_ends, rule
from tom.errors import UserError, check_known
from tom.learners.base import Weighting
from tom.policy.collect import Evaluator
from tom.policy.rollout import mixed_batches, roll_out, start_states
from tom.policy.sac import Sac
from tom.policy.stored import resumed_sac
from tom.readable import whole
from tom.record import RunReader
from tom.reports.figures import learner_colour, strips
from tom.rng import Streams
from tom.studies.frozen import (
    LABELS,
    MODELS,
    UNIFORM,
    WAYS,
    Case,
    buffer_at,
    cases,
    config_of,
    first_sac_step,
    fit_named_model,
    outcome_columns,
    policy_at,
    weighting_of,
)
from tom.studies.moments import (
    Value,
    add_moment_options,
    chosen_runs,
    chosen_ways,
    findings,
    outcome_label,
    sign_test,
    trial_of,
    way_point,
    word_of_rows,
)
from tom.studies.study import Findings, Row, compute
from tom.studies.verdicts import Tables, Verdict

TITLE = "What weighting does for the policy"
QUESTION = "Does the policy return more with weights in the model or in the starts?"
CLAIM = (
    "Policies that are optimised in a model fitted by TOM's weights, from start states drawn by "
    "them, earn higher returns (section 5.2). The paper compares whole runs, and never one of the "
    "two places without the other."
)
PARTS = 5
"""evaluations of the policy, evenly spread over its updates"""
PLACES = {"model": "the model alone", "starts": "the starts alone", "both": "both"}
"""where the weights act"""
TEMPERATURE = "temperature/value"
RULE = "config:model.termination"
"""where the command line keeps `--termination`"""
CAPTION = (
    "Mean-action return while SAC is updated in the model (mean of five evaluations), less that "
    "with uniform weights at the same moment and seed, one point each; the stroke is their median. "
    "Linear within 100, logarithmic beyond."
)


def add_options(parser: ArgumentParser) -> None:
    add_moment_options(parser, (UNIFORM, "tom-mended"))
    parser.add_argument(
        "--termination", dest=RULE, metavar="module:function",
        help="the termination rule of the runs, if it is code of yours; it is used for these runs",
    )  # fmt: skip
    known, updates = (
        ", ".join(f"'{name}'" for name in MODELS),
        "SAC updates, as many as between two fits",
    )
    parser.add_argument("--model", default="200 x 4", help=f"{known} [%(default)s]")
    parser.add_argument("--updates", type=whole(PARTS), default=1250, help=f"{updates} [1250]")
    parser.add_argument("--episodes", type=whole(1), default=5, help="episodes per evaluation [5]")


def find(args: Namespace) -> Findings:
    check_known("model", [args.model], MODELS)
    runs = _runs(args)
    requested = cases(runs, chosen_ways(args), args.seeds, args.moments, (args.model,))
    requested = [replace(case, updates=args.updates, episodes=args.episodes) for case in requested]
    trials = compute(args, improve, requested, outcome_label)
    rows, figures = summary(trials), {"improvement": (CAPTION, improvement_figure(trials))}
    return findings(args, in_sentences(trials), {"summary": rows}, trials, figures)


def _runs(args: Namespace) -> list[RunReader]:
    """The runs with moments from which SAC can go on: old policies were kept without critics.

    Raises UserError if there are none, or the rule that ended a run's modelled episodes is unknown.
    """
    runs = chosen_runs(args)
    able = [run for run in runs if all(policy_at(run, at).critic for at in run.policy_steps())]
    if not able or (args.runs and len(able) < len(runs)):
        lacking = next(run.run_id for run in runs if run not in able)
        raise UserError(f"run {lacking} kept no critics with its policies: name others")
    given, known = getattr(args, RULE), {_rule_of(run) for run in able}
    if given is not None and given not in known:
        raise UserError(f"--termination {given}: no run here was trained with it, leave it out")
    for run in able:
        rule(task(run.env), _rule_of(run))
    return able


def _rule_of(run: RunReader) -> str | None:
    """The name of the rule that ended the run's modelled episodes; None: the task's own."""
    return run.config["config"].get("model", {}).get("termination")


def improve(case: Case) -> Row:
    """Update the policy of a moment in models and from starts with these weights, or without.

    Mean-action returns: `before` the updates, and during them, mean over `PARTS` evaluations, with
    the weights in each of `PLACES`; with uniform weights these are the same. NaN: SAC diverged.
    """
    run, way, seed = RunReader(case.run), WAYS[case.way], case.stream_seed
    config, data = config_of(run, way, seed), buffer_at(run, case.step)
    rows, policy = data.transitions, policy_at(run, case.step)
    weighting = weighting_of(data, policy, config, way)
    # Weights of 1 rather than none: without any, starts are drawn with other random numbers.
    even = torch.ones(len(rows))
    starts = weighting.for_starts(config.rollout)
    starts = even if starts is None else starts
    settings = SacConfig.model_validate(run.config["config"]["sac"])
    steps, values = curve_points(run.metrics(), TEMPERATURE)
    temperature = temperature_at(
        case.step,
        np.append(first_sac_step(run), steps),
        np.append(settings.initial_temperature, values),
    )
    ends = _termination(run, rows, config)

    def during(fit: DynamicsModel, weights: Tensor) -> float:
        sac = resumed_sac(policy, settings, temperature, Streams(seed).torch("sac"))
        return _return_during(sac, fit, ends, rows, weights, config, case)

    weighted = fit_named_model(case.models[0], rows, weighting, config)
    both = during(weighted, starts)
    found = outcome_columns(case, run) | {
        "before": _evaluate(Evaluator(task(run.env), case.episodes), policy.mean, seed)
    }
    if case.way == UNIFORM:
        return found | dict.fromkeys(PLACES, both)
    plain = fit_named_model(case.models[0], rows, Weighting(even), config)
    in_starts = during(plain, starts)
    return found | {"model": during(weighted, even), "starts": in_starts, "both": both}


def temperature_at(step: int, steps: NDArray[Any], values: NDArray[Any]) -> float:
    """The temperature between two records of it (S,), which its optimiser moves in logarithms."""
    return float(np.exp(np.interp(step, steps, np.log(values))))


def _termination(run: RunReader, rows: TensorTransitions, config: OnlineConfig) -> Termination:
    """What ends a modelled episode."""
    known, named = task(run.env), _rule_of(run)
    if not learns_ends(known, named):
        return rule(known, named)
    streams = Streams(config.seed)
    head = EndingHead(known.obs_dim, config.model, streams.torch("ends"))
    head.fit(rows, torch.ones(len(rows)), len(rows), streams.torch("fit ends"))
    return head


def _return_during(
    sac: Sac,
    model: DynamicsModel,
    ends: Termination,
    rows: TensorTransitions,
    weights: Tensor,
    config: OnlineConfig,
    case: Case,
) -> float:
    """Mean of `PARTS` evaluations during the updates on rollouts in the model (lines 21-25)."""
    streams, known = Streams(config.seed), task(config.env)
    dims, rollout = (known.obs_dim, known.action_dim), config.rollout
    replay = ReplayBuffer(len(rows), *dims)
    replay.extend(rows)
    modelled = ReplayBuffer(rollout.starts * rollout.length, *dims)
    generator, policy = streams.torch("rollout"), sac.policy
    starts = start_states(rows, weights, rollout.starts, generator)
    roll_out(model, policy, ends, starts, rollout.length, rollout, modelled, generator)
    evaluator, returns, generator = Evaluator(known, case.episodes), [], streams.torch("batches")
    size, real = sac.config.batch_size, config.real_ratio
    for _ in range(PARTS):
        updates = case.updates // PARTS
        batches = mixed_batches(replay, modelled, updates, size, real, generator)
        metrics = sac.updates(batches)
        if not all(bool(value.isfinite().all()) for value in metrics.values()):
            return nan
        returns.append(_evaluate(evaluator, policy.mean, config.seed))
    return mean(returns)


def _evaluate(evaluator: Evaluator, mean_action: Callable[[Tensor], Tensor], seed: int) -> float:
    """Mean return of the mean policy; the same start states each time."""
    episodes = evaluator.run(mean_action, Streams(seed).integer("evaluation"))
    return mean(float(episode.reward.sum()) for episode in episodes)


# Returns of different tasks have no common unit, and those of one moment vary by chance more than
# by weights. So what counts is on how many recordings a way is better in most of its trials (exact
# sign test); differences of returns are given task by task.


def gaps(trials: Sequence[Row], way: str, place: str) -> list[Value]:
    """Return with the way's weights at `place` less that with uniform weights, trial by trial."""
    uniform = {trial_of(one): one["both"] for one in trials if one["way"] == UNIFORM}
    differences = [
        (one["env"], one["recording"], one[place] - uniform.get(trial_of(one), nan))
        for one in trials
        if one["way"] == way
    ]
    return [value for value in differences if isfinite(value[2])]


def summary(trials: Sequence[Row]) -> list[Row]:
    """One row for the returns before, one for those with uniform weights, and one for each other
    way and place: median differences by task, and how often it is better."""
    plain = [trial for trial in trials if trial["way"] == UNIFORM]
    envs = list(dict.fromkeys(trial["env"] for trial in plain))

    def row(way: str, what: str, values: Sequence[Value], wins: Row) -> Row:
        by_env: dict[str, list[float]] = {env: [] for env in envs}
        for env, _, value in values:
            if isfinite(value):
                by_env[env].append(value)
        unjudged = dict.fromkeys(("better in trials", "n", "better on", "recordings", "p"), "")
        return {
            "way": way,
            "what": what,
            **{env: median(of) if of else nan for env, of in by_env.items()},
            **unjudged,
            "n": len(values),
            **wins,
        }

    rows = [
        row(way, what, [(one["env"], one["recording"], one[column]) for one in plain], {})
        for way, what, column in (("none", "return before", "before"), (UNIFORM, "return", "both"))
    ]
    for way in dict.fromkeys(trial["way"] for trial in trials if trial["way"] != UNIFORM):
        for place, where in PLACES.items():
            found = gaps(trials, way, place)
            signs, better = sign_test(found), sum(gap > 0 for _, _, gap in found)
            wins = {"better in trials": better, "better on": signs.above}
            wins |= {"recordings": signs.n, "p": signs.p}
            rows.append(row(way, f"difference, weights in {where}", found, wins))
    return rows


def in_sentences(trials: Sequence[Row]) -> list[str]:
    """How many trials there are, how far chance moves a return, and what cannot be said."""
    keys = {trial_of(one) for one in trials}
    moments = {(recording, step) for recording, step, _ in keys}
    sentences = [
        f"{len(moments)} moments of {len({recording for recording, _ in moments})} runs, "
        f"{len(keys)} trials of each way."
    ]
    at: dict[tuple[str, str, int], list[float]] = {}
    for one in (one for one in trials if one["way"] == UNIFORM):
        at.setdefault((one["env"], one["recording"], one["step"]), []).append(one["both"])
    seed_gaps: dict[str, list[float]] = {}
    for (env, _, _), values in at.items():
        seed_gaps.setdefault(env, []).extend(abs(a - b) for a, b in combinations(values, 2))
    if noise := [f"{env} {median(of):.0f}" for env, of in seed_gaps.items() if of]:
        sentences[0] += f" Two seeds of uniform weights differ by (median): {', '.join(noise)}."
    if lost := sum(not isfinite(sum(trial[place] for place in PLACES)) for trial in trials):
        sentences.append(f"SAC diverged in {lost} trials, which are left out.")
    return sentences


def verdict(tables: Tables) -> Verdict:
    """By the sign test of every way and place, corrected for their number."""
    difference = "difference, weights"
    table = [
        row
        | {
            "what": row["what"].replace(difference, LABELS.get(row["way"], row["way"])),
            "share": row["better in trials"] / row["n"],
        }
        for row in tables["summary"]
        if row["what"].startswith(difference)
    ]
    trials = [
        f"{row['better in trials']:.0f} of {row['n']:.0f} trials ({row['what']})"
        for row in sorted(table, key=lambda row: row["share"])
    ]
    sentence = (
        f"After one fit, the policy returned more than with uniform weights in {trials[0]} to "
        f"{trials[-1]}; the smallest p of {len(table)} tests is {min(r['p'] for r in table):.2g}."
    )
    against = (
        f"At most {max(row['recordings'] for row in table):.0f} recordings count in a test: only "
        "a large effect of weights could have been seen."
    )
    points = [way_point(row, "share", row["what"]) for row in table]
    word, axis = word_of_rows(table), "share of trials returning more"
    return Verdict(word, sentence, against, axis, 0.5, points)


def improvement_figure(trials: Sequence[Row]) -> Figure:
    """A row for every way and each place where its weights act."""
    rows = {
        f"{name}, {place}": (name, place) for name in WAYS for place in PLACES if name != UNIFORM
    }
    points = [(env, row, gap) for row, of in rows.items() for env, _, gap in gaps(trials, *of)]
    colours = {row: learner_colour(WAYS[way].learner or "") for row, (way, _) in rows.items()}
    figure = strips(colours, points, 0.0, "return less that with uniform weights")
    for ax in figure.axes:
        ax.set_xscale("symlog", linthresh=100)
    return figure
