"""Several learners on one buffer: their weight profiles, and their models' errors along it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import Floats
from app.figures.base import across, band, dashes, line, styled, upright
from app.figures.weights import AGES, AT_AGE, PLACE, WEIGHT_AT, bin_centres, on_log_axis
from app.theme import faded, learner_colour, learner_label, learner_symbol


@dataclass(frozen=True)
class RunErrors:
    """The errors of a run's model, in standard deviations of a step's change."""

    run_id: str
    learner: str
    policy: float
    """on the policy's newest transitions"""
    other: float
    """on the rest of the buffer"""


def probe_profiles(
    profiles: Mapping[str, NDArray[np.float64]],
    random: float,
    height: int,
    *,
    keep: str = "",
) -> go.Figure:
    """The median profile over seeds of each learner (S, bins), with the range of its seeds.

    `random` is the share of the buffer, starting with the oldest row, that is random data. A zoom
    lasts while `keep`, the weighing's name, is the same.
    """
    figure = go.Figure()
    for learner, values in profiles.items():
        x, median = bin_centres(values.shape[1]), np.median(values, 0)
        name, colour = text.plotly(learner_label(learner)), learner_colour(learner)
        if len(values) > 1:
            figure.add_trace(band(x, values.min(0), values.max(0), colour, name, opacity=0.15))
        seeds = f"{len(values)} seed{'s' * (len(values) > 1)}"
        figure.add_trace(
            line(
                x,
                median,
                colour,
                2,
                f"{name}<br>{WEIGHT_AT}",
                shape="hvh",
                customdata=median,
                name=f"{name} ({seeds})",
                meta=text.plotly(learner),
                legendgroup=name,
            )
        )
    marks = [across(1, 1.5, "dash")]
    if random > 0:
        marks.append(upright(100 * random, 1, "dot"))
    styled(
        figure,
        PLACE,
        height,
        keep=f"probe {keep}",
        marks=marks,
        y="mean weight",
        x_axis=AGES,
    )
    return on_log_axis(figure)


def errors_by_age(
    errors: Sequence[tuple[str, str, Floats]], bins: int, height: int, *, keep: str = ""
) -> go.Figure:
    """Mean model error of each part of the buffer; `errors`: (run's name, learner, row errors).

    A zoom lasts while `keep`, the id of the buffer's run, is the same.
    """
    figure = go.Figure()
    usual = dashes([learner for _, learner, _ in errors])
    for (name, learner, error), dash in zip(errors, usual, strict=True):
        parts = np.array_split(error, min(bins, len(error)))
        hover = f"{text.plotly(name)}<br>{AT_AGE}<br>error %{{y:.3g}}<extra></extra>"
        figure.add_trace(
            line(
                bin_centres(len(parts)),
                [part.mean() for part in parts],
                learner_colour(learner),
                2,
                hover,
                dash=dash,
                name=text.plotly(name),
                mode="lines+markers",
                marker={"size": 5, "symbol": learner_symbol(learner)},
            )
        )
    return styled(
        figure,
        PLACE,
        height,
        keep=f"errors by age {keep}",
        y="one-step error (std)",
        x_axis=AGES,
        y_axis={"rangemode": "tozero"},
        showlegend=True,  # a single line may be of another run than the buffer
    )


def focus(groups: Mapping[str, Sequence[RunErrors]], height: int, keep: str) -> go.Figure:
    """For each group, by name, its runs' errors on the policy's transitions and on the others.

    A line joins a run's two errors. The more runs, the closer they stand, each group at its tick.
    """
    figure = go.Figure()
    ticks = []
    for i, (name, runs) in enumerate(groups.items()):
        ticks.append(text.plotly(name))
        for k, run in enumerate(runs):
            colour, run_id = learner_colour(run.learner), text.plotly(run.run_id)
            apart = min(0.12, 0.6 / len(runs))
            nudge = apart * (k - (len(runs) - 1) / 2)
            x = [i - 0.15 + nudge, i + 0.15 + nudge]
            ring = {"color": [colour, "rgba(0,0,0,0)"], "line": {"color": colour, "width": 2}}
            figure.add_trace(
                line(
                    x,
                    [run.policy, run.other],
                    faded(colour, 0.5),
                    1.5,
                    f"{run_id}<br>%{{customdata}}<br>error %{{y:.3g}}<extra></extra>",
                    customdata=["the policy's transitions", "the other transitions"],
                    meta=run_id,
                    mode="lines+markers",
                    marker={"size": 10, "symbol": "circle", **ring},
                    showlegend=False,
                )
            )
    ids = " ".join(run.run_id for runs in groups.values() for run in runs)
    names = {"tickvals": list(range(len(ticks))), "ticktext": ticks}
    return styled(
        figure,
        "",
        height,
        keep=f"{keep} {ids}",
        y="error (std)",
        x_axis={**names, "range": [-0.6, len(ticks) - 0.4]},
        y_axis={"rangemode": "tozero"},
    )
