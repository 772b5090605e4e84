"""Is the model better where the policy goes, and at what price elsewhere?

Each learner weighs the replay buffer of a SAC recording (random half, ordered half) for SAC's final
policy. The paper's model is fitted with those weights from new initial parameters. Its error is
measured on fresh transitions of the policy and on the two halves of the buffer. Nothing is accepted
or refused: the study says which learner's weights helped, and where.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from statistics import median

import torch
from matplotlib.figure import Figure

from tom.analysis.ordered_data import OrderedData, load_run
from tom.analysis.weighing import fit_model, weigh
from tom.config import OnlineConfig, TomConfig
from tom.data.sampling import ess, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.envs import Task, task
from tom.exams.diagnostics import ROWS, one_step_error, rollout_error, rollout_starts, step_scale
from tom.learners import LEARNERS
from tom.learners.base import Policy, Weighting
from tom.policy.collect import footprint
from tom.policy.stored import NAME, read_policy
from tom.record import RunReader
from tom.reports.figures import learner_colour, strips
from tom.reports.report import in_short
from tom.rng import Streams
from tom.studies.frozen import LABELS, MENDED, PRINTED
from tom.studies.moments import sign_test
from tom.studies.study import Findings, Row, add_recordings, compute, recordings
from tom.studies.verdicts import Point, Tables, Verdict, side, word_of
from tom.training.presets import PRESETS, resolve

TITLE = "Model error"
QUESTION = "Is the model better where the policy goes, and at what price elsewhere?"
CLAIM = (
    "Fitting the model to what the current policy meets makes it accurate there, where policy "
    "learning needs it, rather than over all of the replay buffer (figure 1). The paper measures "
    "no model error on MuJoCo tasks."
)
RIVALS = {
    "mle": "MLE",
    "pmac": "PMAC",
    "tom paper": "TOM (paper preset)",
    "tom mended": "TOM (mended preset)",
    "tom exact": "TOM (exact preset)",
}
"""the learners compared: TOM as printed, mended, and with the preset of `TomConfig`"""
QUANTITIES = {
    "policy": "policy's own",
    "policy_rollout": "own, 5 steps",
    "ordered": "ordered half",
    "random": "random half",
}
"""the errors and the data on which they are measured: one step and five steps under the policy on
transitions that it makes anew, one step on rows of the buffer's two halves"""
CAPTION = (
    "Error of each learner's model over MLE's, one point per seed (1: no difference). The buffer's "
    "two halves are in-sample; the policy's own transitions are new to every learner."
)


add_options = add_recordings


def find(args: Namespace) -> Findings:
    runs = recordings(args)
    cases = [
        Case(run.path, rival, seed, made=run.created)
        for run in runs
        for seed in args.seeds
        for rival in RIVALS
    ]
    results = compute(
        args, focus, cases, lambda one: f"{one['recording']}: {one['rival']} seed {one['seed']}"
    )
    return Findings(
        sentences=in_sentences(results),
        files={"errors": results, "summary": summary(results)},
        titles={"summary": "Medians over seeds"},
        figures={"errors": (CAPTION, error_figure(results))},
        origin={
            "n": f"{len(runs)} recordings, {len(args.seeds)} seeds on each",
            "seeds": in_short(args.seeds),
        },
    )


@dataclass(frozen=True)
class Case:
    """One learner under one seed on one recording, with the model of a run's `preset`.

    A seed draws the footprint for TOM, the networks, the minibatches and the test transitions. Only
    the policy's fresh transitions are new to every learner; the models were fitted to those of the
    buffer's two halves, except the held-out ones.
    """

    recording: Path
    rival: str
    seed: int
    preset: str = "paper"
    made: str = ""  # time of creation: a new recording under the same path is another case


def focus(case: Case) -> Row:
    """Weigh, fit and test one case: ESS and errors, in standard deviations of a step's change."""
    run = RunReader(case.recording)
    data, policy, known = load_run(run), read_policy(run.path / NAME), task(run.env)
    config = _config(run.env, case.rival, case.preset).but(seed=case.seed)
    (weighed,) = weigh(data, policy, known, config, (config.learner,), (case.seed,))
    weights, tested = (
        torch.from_numpy(weighed.weights),
        _collect_test_rows(data, policy, known, case.seed),
    )
    weighting = Weighting(weights, clipped=LEARNERS[config.learner].clipped)
    model = fit_model(data.transitions, weighting, config.model, case.seed)
    scale, anew = step_scale(data.transitions), tested["policy"]
    errors = {name: one_step_error(model, rows, scale) for name, rows in tested.items()}
    errors["policy_rollout"] = rollout_error(model, anew, rollout_starts(anew), scale)
    return {
        "recording": f"{run.env}-s{run.seed}",
        "rival": case.rival,
        "seed": case.seed,
        "ess": ess(weights),
        **{name: errors[name] for name in QUANTITIES},
    }


def _collect_test_rows(
    data: OrderedData, policy: Policy, known: Task, seed: int
) -> dict[str, TensorTransitions]:
    """The test data of all models of one seed."""
    streams, rows, first = Streams(seed), data.transitions, data.ordered_from
    generator = streams.torch("focus")
    anew = footprint(known, policy, ROWS, streams.integer("focus env"), generator)
    ordered = first + uniform_indices(len(rows) - first, ROWS, generator)
    random = uniform_indices(first, ROWS, generator)
    return {"policy": anew.transitions.torch(), "ordered": rows[ordered], "random": rows[random]}


def _config(env: str, rival: str, preset: str) -> OnlineConfig:
    learner, _, of_tom = rival.partition(" ")
    config = resolve(env, learner, preset)
    assert isinstance(config, OnlineConfig)
    if of_tom == "mended":
        return config.but(tom=TomConfig.model_validate(PRESETS[of_tom]["tom"]).model_dump())
    objective = TomConfig.preset("exact" if of_tom == "exact" else "paper")
    return config.but(tom=objective.model_dump())


def shares(results: Sequence[Row]) -> list[Row]:
    """The results with errors relative to MLE's on the same recording and seed."""
    mle = {(one["recording"], one["seed"]): one for one in results if one["rival"] == "mle"}
    return [
        one | {name: one[name] / mle[one["recording"], one["seed"]][name] for name in QUANTITIES}
        for one in results
    ]


def summary(results: Sequence[Row]) -> list[Row]:
    """Medians over seeds, one row per recording and rival, with errors relative to MLE's."""
    rows = []
    for key in dict.fromkeys((one["recording"], one["rival"]) for one in results):
        own, over = (
            [one for one in some if (one["recording"], one["rival"]) == key]
            for some in (results, shares(results))
        )
        row: Row = {"recording": key[0], "rival": key[1], "ess": median(one["ess"] for one in own)}
        for name in QUANTITIES:
            row[name] = median(one[name] for one in own)
            row[f"{name} / mle"] = median(one[name] for one in over)
        rows.append(row)
    return rows


def in_sentences(results: Sequence[Row]) -> list[str]:
    """For each learner except MLE: where its model is better than MLE's."""
    over, sentences = shares(results), []
    for rival in dict.fromkeys(one["rival"] for one in over if one["rival"] != "mle"):
        of = {name: [one[name] for one in over if one["rival"] == rival] for name in QUANTITIES}
        ratios = (
            f"{QUANTITIES[name]} {median(own):.2f} (less in {sum(x < 1 for x in own)}/{len(own)})"
            for name, own in of.items()
        )
        sentences.append(f"{RIVALS[rival]}: error over MLE's, median: {', '.join(ratios)}.")
    return sentences


def verdict(tables: Tables) -> Verdict:
    """By a sign test over recordings of each of TOM's presets, corrected for their number."""
    names = {"pmac": "PMAC", "tom paper": LABELS[PRINTED], "tom mended": LABELS[MENDED],
             "tom exact": "TOM exact"}  # fmt: skip
    rows = [row for row in tables["summary"] if row["rival"] in names]
    ours = [row for row in rows if row["rival"].startswith("tom")]
    signs = {
        names[name]: sign_test(
            ("", row["recording"], 1 - row["policy / mle"]) for row in ours if row["rival"] == name
        )
        for name in dict.fromkeys(row["rival"] for row in ours)
    }
    sides = [side(one.p * len(signs), 2 * one.above > one.n) for one in signs.values()]
    counts = [f"{name} on {one.above} of {one.n}" for name, one in signs.items()]
    sentence = (
        "On new steps of the policy, the model errs less than MLE's: "
        f"{', '.join(counts)} recordings (smallest p {min(one.p for one in signs.values()):.2g})."
    )
    least = min(1.0, 2.0 ** (1 - max(one.n for one in signs.values())))
    against = (
        "On the buffer's random half, the error is "
        f"{median(row['random / mle'] for row in ours):.2f} times MLE's (median). With so few "
        f"recordings, p cannot be below {least:.2g}."
    )
    points = [
        Point(
            row["recording"], names[rival := row["rival"]], row["policy / mle"], nan, nan,
            rival.partition(" ")[0], PRINTED if rival == "tom paper" else "",
        )
        for row in rows
    ]  # fmt: skip
    axis = "model error where the policy goes (1: as MLE's)"
    return Verdict(word_of(sides), sentence, against, axis, 1, points)


def error_figure(results: Sequence[Row]) -> Figure:
    """A panel per recording; the error relative to MLE's with the same seed."""
    rows = {
        (rival, quantity): f"{label}: {where}"
        for quantity, where in QUANTITIES.items()
        for rival, label in RIVALS.items()
        if rival != "mle"
    }
    over = shares(results)
    points = [
        (one["recording"], row, one[quantity])
        for (rival, quantity), row in rows.items()
        for one in over
        if one["rival"] == rival
    ]
    colours = {row: learner_colour(rival.split()[0]) for (rival, _), row in rows.items()}
    return strips(colours, points, 1.0, "model error over MLE's", [0.5, 0.75, 1, 1.5, 2, 3, 4])
