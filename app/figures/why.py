"""A weight as the sum of its terms, rollouts from a row, and the errors of brushed models."""

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import Floats
from app.data.weighings import Brushed
from app.figures.base import line, note, styled
from app.figures.statistics import intervals
from app.theme import NEUTRAL, Mode, learner_colour, ramp
from tom import readable
from tom.analysis.brush import POLICY, REGION, REST
from tom.analysis.why import Sum
from tom.studies.verdicts import Point

NAMES = {
    REGION: "held-out, in the region",
    REST: "held-out, elsewhere",
    POLICY: "new steps of the policy",
}
BELOW = "#6f9fe8"


def factor_text(factor: float) -> str:
    """0.25 -> x 1/4."""
    return f"x {readable.factor(factor)}"


def brushed_errors(brushed: Brushed, height: int, mode: Mode) -> go.Figure:
    """A line per region with a point per factor: the mean over seeds and the range.

    Where no error could be measured there is no point.
    """
    regions = [name for name in NAMES if name in brushed.errors]
    points, colours = [], []
    for factor, colour in zip(brushed.factors, ramp(len(brushed.factors), mode), strict=True):
        for name in regions:
            ratio = brushed.change(name, factor)
            if len(ratio := ratio[np.isfinite(ratio)]):
                ends = float(ratio.mean()), float(ratio.min()), float(ratio.max())
                points.append(Point(NAMES[name], f"weight {factor_text(factor)}", *ends))
                colours.append(colour)
    axis = "one-step error over that with unchanged weights"
    figure = intervals(points, colours, axis, 1, height, f"brush {brushed.name}")
    seeds = len(next(iter(brushed.errors[regions[0]].values())))
    return note(figure, [f"mean and range of {seeds} seeds"])


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
            y=[*(value for _, _, value in bars), parts.argument, parts.weight],
            name="the sum",
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
    layout = {"showlegend": False, "margin": {"t": 30, "b": 8}}
    zero = {"zeroline": True, "zerolinecolor": NEUTRAL}
    return styled(figure, "", height, keep=f"why {parts}", y_axis=zero, **layout)


def rollout_lines(
    paths: Floats, recorded: NDArray, name: str, learner: str, height: int
) -> go.Figure:
    """One dimension of rollouts (K, T + 1) and of the record from the same state on."""
    figure = go.Figure()
    hover = "step %{x}<br>%{y:.3g}<extra>"
    # All rollouts are one trace with gaps, so that there is only one legend entry.
    gaps = np.full((len(paths), 1), np.nan)
    x = np.tile(np.append(np.arange(paths.shape[1]), np.nan), len(paths))
    y = np.concatenate([paths, gaps], 1).ravel()
    named = {"name": "rollouts of the policy in the model", "opacity": 0.45}
    figure.add_trace(line(x, y, learner_colour(learner), 1.2, f"{hover}model</extra>", **named))
    named = {"name": "recorded, by the policy at the time", "mode": "lines+markers"}
    marked = {**named, "marker": {"size": 5}}
    steps = np.arange(len(recorded))
    figure.add_trace(line(steps, recorded, NEUTRAL, 2.5, f"{hover}recorded</extra>", **marked))
    kept = f"rollouts {name} from {recorded[0]}"
    styled(figure, "steps", height, keep=kept, y=text.plotly(name))
    ended = int(np.isnan(paths[:, -1]).sum())
    return note(figure, [f"{ended} of {len(paths)} rollouts ended before"] if ended else [])
