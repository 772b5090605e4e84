"""Several learners on one buffer: their weight profiles, and their models' errors along it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import Floats
from app.figures.base import across, band, dashes, styled, upright
from app.figures.weights import AGES, bin_centres, on_log_axis
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
    log: bool,
    keep: str = "",
) -> go.Figure:
    """The median profile over seeds of each learner (S, bins), with the range of its seeds.

    `random` is the share of the buffer, starting with the oldest row, that is random data. A zoom
    lasts while `keep`, the weighing's name, is the same.
    """
    figure = go.Figure()
    for learner, values in profiles.items():
        x, median = bin_centres(values.shape[1]), np.median(values, 0)
        name = text.plotly(learner_label(learner))
        if len(values) > 1:
            ends = values.min(0), values.max(0)
            figure.add_trace(band(x, *ends, learner_colour(learner), name, opacity=0.15))
        figure.add_trace(
            go.Scatter(
                x=x,
                y=median,
                customdata=median,
                name=f"{name} ({len(values)} seed{'s' * (len(values) > 1)})",
                meta=text.plotly(learner),
                mode="lines",
                line={"color": learner_colour(learner), "width": 2, "shape": "hvh"},
                legendgroup=name,
                hovertemplate=f"{name}<br>at %{{x:.0f}} % of the buffer (0: oldest)"
                "<br>weight %{customdata:.3g}<extra></extra>",
            )
        )
    marks = [across(1, 1.5, "dash")]
    if random > 0:
        marks.append(upright(100 * random, 1, "dot"))
    styled(figure, "position in the buffer", height, keep=f"probe {keep}", marks=marks)
    figure.update_xaxes(**AGES)
    figure.update_yaxes(title_text="mean weight", type="linear")
    return on_log_axis(figure) if log else figure


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
        figure.add_trace(
            go.Scatter(
                x=bin_centres(len(parts)),
                y=[part.mean() for part in parts],
                name=text.plotly(name),
                mode="lines+markers",
                line={
                    "color": learner_colour(learner),
                    "width": 2,
                    "dash": dash,
                },
                marker={"size": 5, "symbol": learner_symbol(learner)},
                hovertemplate=f"{text.plotly(name)}<br>at %{{x:.0f}} % of the buffer (0: oldest)"
                "<br>error %{y:.3g}<extra></extra>",
            )
        )
    styled(figure, "position in the buffer", height, keep=f"errors by age {keep}")
    figure.update_xaxes(**AGES)
    figure.update_yaxes(title_text="one-step error (std)", rangemode="tozero")
    figure.update_layout(showlegend=True)  # a single line may be of another run than the buffer
    return figure


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
            figure.add_trace(
                go.Scatter(
                    x=[i - 0.15 + nudge, i + 0.15 + nudge],
                    y=[run.policy, run.other],
                    customdata=["the policy's transitions", "the other transitions"],
                    meta=run_id,
                    mode="lines+markers",
                    line={"color": faded(colour, 0.5), "width": 1.5},
                    marker={
                        "size": 10,
                        "color": [colour, "rgba(0,0,0,0)"],
                        "line": {"color": colour, "width": 2},
                        "symbol": "circle",
                    },
                    showlegend=False,
                    hovertemplate=f"{run_id}<br>%{{customdata}}<br>error %{{y:.3g}}<extra></extra>",
                )
            )
    ids = " ".join(run.run_id for runs in groups.values() for run in runs)
    styled(figure, "", height, keep=f"{keep} {ids}")
    figure.update_xaxes(
        tickvals=list(range(len(ticks))), ticktext=ticks, range=[-0.6, len(ticks) - 0.4]
    )
    figure.update_yaxes(title_text="error (std)", rangemode="tozero")
    return figure
