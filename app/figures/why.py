"""A weight as the sum of its terms, and rollouts from its transition."""

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import Floats
from app.figures.base import note, styled
from app.theme import NEUTRAL, learner_colour
from tom import readable
from tom.analysis.why import Sum

BELOW = "#6f9fe8"


def waterfall(parts: Sum, learner: str, height: int) -> go.Figure:
    """The terms of y - lambda one after another, and the resulting weight."""
    bars = [
        ("r", "log p/q, from the discriminator", parts.log_ratio),
        ("+ g E Q(s', a')", "what the policy does next", parts.following),
    ]
    if parts.restart:
        bars.append(("+ g E Q(s0, a0)", "a new start after the end (mu0)", parts.restart))
    bars.append(("- Q(s, a)", "the state itself", -parts.now))
    if parts.level:
        bars.append(("- level", "lambda: the mean weight is 1", -parts.level))
    names = [name for name, _, _ in bars]
    figure = go.Figure(
        go.Waterfall(
            x=[*names, "sum", "weight"],
            y=[*(value for _, _, value in bars), 0, parts.weight],
            measure=["relative"] * len(bars) + ["total", "absolute"],
            text=[f"{v:+.3g}" for _, _, v in bars]
            + [readable.short(parts.argument), readable.short(parts.weight)],
            customdata=[*(words for _, words, _ in bars), "y - lambda", "f*'(sum) / mean"],
            textposition="outside",
            cliponaxis=False,
            increasing={"marker": {"color": learner_colour(learner)}},
            decreasing={"marker": {"color": BELOW}},
            totals={"marker": {"color": NEUTRAL}},
            connector={"line": {"color": NEUTRAL, "width": 1, "dash": "dot"}},
            hovertemplate="%{x}: %{text}<br>%{customdata}<extra></extra>",
        )
    )
    styled(figure, "", height, keep=f"why {parts}")
    figure.update_layout(showlegend=False, margin={"t": 30, "b": 8})
    figure.update_yaxes(zeroline=True, zerolinecolor=NEUTRAL)
    return figure


def rollout_lines(
    paths: Floats, recorded: NDArray, name: str, learner: str, height: int
) -> go.Figure:
    """One dimension of rollouts (K, T + 1) and of the record from the same state on."""
    figure = go.Figure()
    colour = learner_colour(learner)
    steps = np.arange(paths.shape[1])
    # All rollouts are one trace with gaps, so that there is only one legend entry.
    gap = np.full((len(paths), 1), np.nan)
    figure.add_trace(
        go.Scatter(
            x=np.tile(np.append(steps, np.nan), len(paths)),
            y=np.concatenate([paths, gap], 1).ravel(),
            mode="lines",
            name="rollouts of the policy in the model",
            opacity=0.45,
            line={"color": colour, "width": 1.2},
            hovertemplate="step %{x}<br>%{y:.3g}<extra>model</extra>",
        )
    )
    figure.add_trace(
        go.Scatter(
            x=np.arange(len(recorded)),
            y=recorded,
            mode="lines+markers",
            name="recorded, by the policy of its time",
            line={"color": NEUTRAL, "width": 2.5},
            marker={"size": 5},
            hovertemplate="step %{x}<br>%{y:.3g}<extra>recorded</extra>",
        )
    )
    styled(figure, "steps", height, keep=f"rollouts {name} from {recorded[0]}")
    figure.update_yaxes(title_text=text.plotly(name))
    ended = int(np.isnan(paths[:, -1]).sum())
    return note(figure, f"{ended} of {len(paths)} rollouts ended before") if ended else figure
