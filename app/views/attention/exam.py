"""The exam of the chosen fit: the footprint of its weights, and its model's errors."""

from collections.abc import Mapping, Sequence

import numpy as np
import streamlit as st

from app import text
from app.data import readers
from app.data.exams import at_fit
from app.parts.readout import Number
from tom.config import OWN_LOOP, Settings
from tom.exams.energy import informative
from tom.learners import LEARNERS
from tom.metrics import describe
from tom.readable import short
from tom.record.reader import RunReader

NUMBERS = {
    "footprint": "exam/footprint",
    "its noise": "exam/footprint_noise",
    "error, one step": "exam/error",
    "error, five steps": "exam/rollout_error",
}


def numbers(run: RunReader, fits: Sequence[int]) -> list[Number]:
    """What the exams of a run's fits (F,) measured, if any fit has one."""
    frame = readers.metrics(run)
    exams = frame.drop_duplicates("env_step", keep="last").set_index("env_step").reindex(fits)
    return [
        Number(name, [short(value) for value in exams[path]], describe(path))
        for name, path in NUMBERS.items()
        if path in exams and np.isfinite(exams[path].to_numpy(np.float64)).any()
    ]


def say(run: RunReader, fit: int) -> None:
    """What the exam of a fit means, or why it has none."""
    frame = readers.metrics(run)
    metrics = at_fit(frame, fit)
    if not metrics:
        st.caption(without(run, any(name.startswith("exam/") for name in frame.columns)))
        return
    words = (in_words(metrics), of_which_weights(run.learner, run.settings))
    st.caption(
        "The exam of this fit: the steps that its policy made next, which were not in its buffer. "
        + text.markdown(" ".join(filter(None, words)))
    )


def without(run: RunReader, examined: bool) -> str:
    """Why a fit has no exam; `examined`: another fit of the run has one."""
    if run.own_loop and run.learner == OWN_LOOP:
        return "No exam: weights that a loop hands in sit none, those of `tom.weigh_live` do."
    if not examined and not run.status.alive:
        return (
            "No exam: the run is of a version before fits were examined, or ended while its first "
            "fit served."
        )
    if run.status.alive:
        return "No exam yet: it is over with the next fit."
    return "This fit sat no exam."


def of_which_weights(learner: str, settings: Settings) -> str:
    """How the weights of an exam, the fit's, differ from those that were recorded; else empty."""
    share = float(settings.get("model.uniform_share", 0))
    if share == 1:
        return (
            "Its model was fitted with every transition counting the same (model.uniform_share 1), "
            "and the exam is of that; the weights above choose the rollouts' starts alone."
        )
    changes = [f"a share of {share:g} of them uniform"] if share else []
    if learner in LEARNERS and LEARNERS[learner].clipped and "model.weight_clip" in settings:
        changes.insert(0, f"clipped at {float(settings['model.weight_clip']):g}")
    if not changes:
        return ""
    return f"The exam is of the weights that the fit counts: those above, {' and '.join(changes)}."


def in_words(metrics: Mapping[str, float]) -> str:
    """The meaning of an exam's numbers for the weights and the model."""
    said = [about_weights(metrics)]
    if "exam/error" in metrics:
        ahead = metrics.get("exam/rollout_error")
        five = "" if ahead is None else f", after five steps by {short(ahead)}"
        said.append(
            f"One step ahead its model errs by {short(metrics['exam/error'])} standard deviations "
            f"of a step's change{five}."
        )
    return " ".join(said)


def about_weights(metrics: Mapping[str, float]) -> str:
    """Whether the weights moved the buffer closer to the policy's transitions, beyond noise."""
    uniform, footprint, noise = (
        metrics.get(f"exam/{name}")
        for name in ("footprint_uniform", "footprint", "footprint_noise")
    )
    if uniform is None:
        return "Too few steps to tell where the weights should lie."
    if footprint is None or noise is None or not informative(noise):
        return (
            "The footprint cannot be measured at this fit: without weights the buffer lies no "
            "farther from these steps than two halves of them from each other."
        )
    if footprint < 1 - abs(noise):
        return (
            f"The weights bring the buffer nearer to what the policy did: {footprint:.2f} of the "
            "distance without weights is left."
        )
    if footprint > 1 + abs(noise):
        return (
            f"The weights take the buffer away from what the policy did: it lies {footprint:.2f} "
            "times as far as without weights."
        )
    return (
        "With its weights the buffer lies as near to what the policy did as without, but for noise."
    )
