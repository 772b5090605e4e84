"""The exams of fits: the footprint of their weights, their errors, and the next return."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from app import text
from app.data.exams import Exams
from app.figures.base import LAYOUT, X_AXIS, Y_AXIS, note, upright
from app.theme import faded, learner_colour, learner_label, learner_symbol
from tom.readable import score, short
from tom.spread import spread

FITS = 1500
"""maximum number of drawn fits; the figure says if fits were left out"""
TICKS = [digit * 10.0**power for power in range(-5, 5) for digit in (1, 2, 5)]
LEGEND = 8  # size of a legend's marker in pixels


def footprint_error_return(exams: Sequence[Exams], height: int) -> go.Figure:
    """One point per fit, coloured by learner: footprint and next return against error.

    Both panels share the error axis, so that a fit is at the same height in both. Uninformative
    footprints (`Exams.telling`) are left out of the first panel, which says so.
    """
    figure = make_subplots(rows=1, cols=2, shared_yaxes=True, horizontal_spacing=0.03)
    share = min(FITS / max(sum(len(run.step) for run in exams), 1), 1.0)
    shown = [run.at(spread(len(run.step), int(np.ceil(share * len(run.step))))) for run in exams]
    for learner in dict.fromkeys(run.learner for run in shown):
        runs = [run for run in shown if run.learner == learner]
        figure.add_trace(_points(learner, [run.at(run.telling) for run in runs], "footprint"), 1, 1)
        figure.add_trace(_points(learner, runs, "returns"), 1, 2)
        # The legend's entry, also if the first panel has none of the learner's points.
        key = {"size": LEGEND, "color": learner_colour(learner), "symbol": learner_symbol(learner)}
        named = {"name": text.plotly(learner_label(learner)), "legendgroup": text.plotly(learner)}
        figure.add_trace(go.Scatter(x=[None], y=[None], mode="markers", marker=key, **named), 1, 1)
    marks = [upright(0, 1, "dot"), upright(1, 1, "dot")]
    keep = " ".join(["exams", *(run.run_id for run in exams)])
    figure.update_layout(**LAYOUT, height=height, uirevision=keep, shapes=marks)
    figure.update_yaxes(**Y_AXIS, type="log", tickvals=TICKS, ticktext=[f"{at:g}" for at in TICKS])
    footprint = "footprint (0: like the policy itself, 1: as without weights)"
    figure.update_xaxes(**X_AXIS, title_text=footprint, col=1)
    figure.update_xaxes(**X_AXIS, title_text="return of the next evaluation", col=2)
    figure.update_yaxes(title_text="one-step error in the exam (std)", col=1)
    fits, drawn = (sum(len(run.step) for run in of) for of in (exams, shown))
    words = [f"{drawn:,} of {fits:,} fits are drawn"] if drawn < fits else []
    if mute := sum(int((~run.telling).sum()) for run in exams):
        words.append(f"without {mute:,} of {fits:,} fits, whose footprint says nothing")
    return note(figure, words, right=0.48)


def _points(learner: str, runs: Sequence[Exams], x: str) -> go.Scatter:
    colour, symbol = learner_colour(learner), {"symbol": learner_symbol(learner)}
    return go.Scatter(
        x=np.concatenate([getattr(run, x) for run in runs]),
        y=np.concatenate([run.error for run in runs]),
        hovertext=[words for run in runs for words in hover(run)],
        hoverinfo="text",
        name=text.plotly(learner_label(learner)),
        meta=text.plotly(learner),
        mode="markers",
        marker={"size": 6, "color": faded(colour, 0.8), "line": {"width": 0}} | symbol,
        legendgroup=text.plotly(learner),
        showlegend=False,
    )


def hover(run: Exams) -> list[str]:
    """The hover text of each fit (F,)."""
    who = f"<b>{text.plotly(run.group)}</b> seed {run.seed}<br>{text.plotly(run.run_id)}"
    lines = []
    for i, step in enumerate(run.step):
        nothing = "" if run.telling[i] else ": says nothing"
        footprint = f"{short(run.footprint[i])} (noise {short(run.noise[i])}{nothing})"
        lines.append(
            f"{who}<br>fit at step {step:,}<br>footprint {footprint}"
            f"<br>error {short(run.error[i])}, five steps {short(run.rollout_error[i])}"
            f"<br>return of the next evaluation {score(float(run.returns[i]))}"
        )
    return lines
