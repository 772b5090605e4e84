"""The change of models' errors when a region of the buffer counts more or less."""

import numpy as np
import plotly.graph_objects as go

from app.data.weighings import Brushed
from app.figures.base import across, note, styled
from app.theme import Mode, ramp
from tom import readable
from tom.analysis.brush import POLICY, REGION, REST

NAMES = {
    REGION: "held-out, in the region",
    REST: "held-out, elsewhere",
    POLICY: "what the policy does anew",
}


def factor_in_words(factor: float) -> str:
    """0.25 -> x 1/4."""
    return f"x {readable.factor(factor)}"


def change(brushed: Brushed, region: str, factor: float) -> np.ndarray:
    """The model's error (S,) for each seed, relative to the original weights."""
    of = brushed.errors[region]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.array(of[factor]) / np.array(of[1.0])


def error_bars(brushed: Brushed, height: int, mode: Mode) -> go.Figure:
    """One group of bars per region, one bar per factor: the mean over seeds and the range.

    Where no error could be measured there is no bar.
    """
    figure = go.Figure()
    regions = [name for name in NAMES if name in brushed.errors]
    colours = ramp(len(brushed.factors), mode)
    for factor, colour in zip(brushed.factors, colours, strict=True):
        ratios = [change(brushed, name, factor) for name in regions]
        measured = [r[np.isfinite(r)] for r in ratios]
        means, least, most = (
            np.array([of(r) if len(r) else np.nan for r in measured])
            for of in (np.mean, np.min, np.max)
        )
        figure.add_trace(
            go.Bar(
                x=[NAMES[name] for name in regions],
                y=means - 1,
                base=1,
                name=f"weight {factor_in_words(factor)}",
                marker={"color": colour},
                error_y={
                    "array": most - means,
                    "arrayminus": means - least,
                    "thickness": 1.4,
                    "width": 4,
                },
                customdata=np.stack([means, least, most], -1),
                hovertemplate="%{x}<br>error x %{customdata[0]:.3f} "
                "(%{customdata[1]:.3f} to %{customdata[2]:.3f})<extra>%{fullData.name}</extra>",
            )
        )
    styled(figure, "", height, keep=f"brush {brushed.name}", marks=[across(1, 1.5, "dash")])
    figure.update_yaxes(title_text="one-step error, times that of the weights as they are")
    figure.update_layout(barmode="group", bargap=0.25)
    seeds = len(next(iter(brushed.errors[regions[0]].values())))
    return note(figure, f"mean and range of {seeds} seeds")
