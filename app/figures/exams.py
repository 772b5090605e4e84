"""The exams of fits, their footprints, errors and next returns; and models' errors in sample."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from app import text
from app.data.buffer import Floats
from app.figures.base import dashes, line, note, panels, styled, vertical_line
from app.figures.weights import AGES, AT_AGE, PLACE, bin_centres
from app.theme import learner_colour, learner_symbol, with_alpha
from tom.analysis.exams import Exams
from tom.learners import learner_label
from tom.readable import score, short
from tom.spread import spread

FITS = 1500
"""maximum number of drawn fits; the figure says if fits were left out"""
TICKS = [digit * 10.0**power for power in range(-5, 5) for digit in (1, 2, 5)]
LEGEND = 8  # size of a legend's marker in pixels


def footprint_error_return(exams: Sequence[Exams], height: int) -> go.Figure:
    """One point per fit, coloured by learner: footprint and next return against error.

    Both panels share the error axis, so that a fit is at the same height in both. Uninformative
    footprints (`Exams.informative`) are left out of the first panel, which says so.
    """
    keep = " ".join(["exams", *(run.run_id for run in exams)])
    figure = panels(1, 2, height, keep, shared_yaxes=True, horizontal_spacing=0.03)
    share = min(FITS / max(sum(len(run.step) for run in exams), 1), 1.0)
    shown = [
        run.subset(spread(len(run.step), int(np.ceil(share * len(run.step))))) for run in exams
    ]
    for learner in dict.fromkeys(run.learner for run in shown):
        runs = [run for run in shown if run.learner == learner]
        figure.add_trace(
            _points(learner, [run.subset(run.informative) for run in runs], "footprint"), 1, 1
        )
        figure.add_trace(_points(learner, runs, "returns"), 1, 2)
        # The legend's entry, also if the first panel has none of the learner's points.
        key = {"size": LEGEND, "color": learner_colour(learner), "symbol": learner_symbol(learner)}
        named = {"name": text.plotly(learner_label(learner)), "legendgroup": text.plotly(learner)}
        figure.add_trace(go.Scatter(x=[None], y=[None], mode="markers", marker=key, **named), 1, 1)
    figure.update_layout(shapes=[vertical_line(0, 1, "dot"), vertical_line(1, 1, "dot")])
    figure.update_yaxes(type="log", tickvals=TICKS, ticktext=[f"{at:g}" for at in TICKS])
    footprint = "footprint (0: the policy itself, 1: as without weights)"
    figure.update_xaxes(title_text=footprint, col=1)
    figure.update_xaxes(title_text="return of the next evaluation", col=2)
    figure.update_yaxes(title_text="one-step error in the exam (std)", col=1)
    fits, drawn = (sum(len(run.step) for run in of) for of in (exams, shown))
    words = [f"{drawn:,} of {fits:,} fits are drawn"] if drawn < fits else []
    if mute := sum(int((~run.informative).sum()) for run in exams):
        words.append(f"without {mute:,} of {fits:,} fits, whose footprint says nothing")
    return note(figure, words, right=0.48)


def _points(learner: str, runs: Sequence[Exams], x: str) -> go.Scatter:
    colour, symbol = learner_colour(learner), {"symbol": learner_symbol(learner)}
    return go.Scatter(
        x=np.concatenate([getattr(run, x) for run in runs]),
        y=np.concatenate([run.error for run in runs]),
        hovertext=[_hover(run, i) for run in runs for i in range(len(run.step))],
        hoverinfo="text",
        name=text.plotly(learner_label(learner)),
        meta=text.plotly(learner),
        mode="markers",
        marker={"size": 6, "color": with_alpha(colour, 0.8), "line": {"width": 0}} | symbol,
        legendgroup=text.plotly(learner),
        showlegend=False,
    )


def _hover(run: Exams, i: int) -> str:
    nothing = "" if run.informative[i] else ": says nothing"
    return (
        f"<b>{text.plotly(run.group)}</b> seed {run.seed}<br>{text.plotly(run.run_id)}"
        f"<br>fit at step {run.step[i]:,}"
        f"<br>footprint {short(run.footprint[i])} (noise {short(run.noise[i])}{nothing})"
        f"<br>error {short(run.error[i])}, five steps {short(run.rollout_error[i])}"
        f"<br>return of the next evaluation {score(float(run.returns[i]))}"
    )


def errors_by_age(
    errors: Sequence[tuple[str, str, Floats]], bins: int, height: int, *, keep: str = ""
) -> go.Figure:
    """Mean model error of each part of the buffer; `errors`: (run's name, learner, row errors).

    A zoom lasts while `keep`, the id of the buffer's run, is the same.
    """
    figure = go.Figure()
    dash_styles = dashes([learner for _, learner, _ in errors])
    for (name, learner, error), dash in zip(errors, dash_styles, strict=True):
        parts = np.array_split(error, min(bins, len(error)))
        means, colour = [part.mean() for part in parts], learner_colour(learner)
        hover = f"{text.plotly(name)}<br>{AT_AGE}<br>error %{{y:.3g}}<extra></extra>"
        more: dict[str, Any] = {"name": text.plotly(name), "mode": "lines+markers"}
        more |= {"marker": {"size": 5, "symbol": learner_symbol(learner)}}
        figure.add_trace(line(bin_centres(len(parts)), means, colour, 2, hover, dash=dash, **more))
    lone: dict[str, Any] = {"showlegend": True}  # a single one may be of another run
    zero, kept = {"rangemode": "tozero"}, f"errors by age {keep}"
    y = "one-step error (std)"
    return styled(figure, PLACE, height, keep=kept, y=y, x_axis=AGES, y_axis=zero, **lone)
