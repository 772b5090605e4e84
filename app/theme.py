"""Colours: one for each learner everywhere, readable on light and dark and by the colour-blind."""

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tom.config import SAC_ALONE
from tom.learners import LEARNERS

Mode = Literal["light", "dark"]

# These learn no model. They are drawn beside the learners in muted tones.
BASELINE_COLOURS: dict[str, str] = {
    "expert-only": "#6d7686",
    "footprint-only": "#98815f",
    SAC_ALONE: "#7d6f66",
}
_SPARE_COLOURS = ("#7a6ff0", "#8f6a4e", "#5f8a1f", "#a8506e")
# For groups without a learner's colour; also the colour-blind can tell them apart and from neutral.
QUALITATIVE = ("#0096ff", "#c31e2d", "#a5960f", "#693cf0", "#963ca5", "#b43c5a")
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon")
LEARNER_COLOURS = {name: entry.colour for name, entry in LEARNERS.items() if entry.colour}
NEUTRAL = "#8a92a3"
REAL: dict[Mode, str] = {"light": "#5b6577", "dark": "#aeb7c8"}
"""a recorded robot, beside a model's ghosts of it"""
BACKGROUND: dict[Mode, str] = {"light": "#ffffff", "dark": "#12151c"}
SURFACE: dict[Mode, str] = {"light": "#f4f6fa", "dark": "#1b202b"}
TEXT: dict[Mode, str] = {"light": "#1c2330", "dark": "#e8ecf4"}
BORDER: dict[Mode, str] = {"light": "#dde2ec", "dark": "#2c3342"}

LEAST_CONTRAST = 3.05
"""the least contrast of a line with either background: 3:1, with room for rounding"""

# Buttons and sliders: no learner's colour, so that colour always means data.
ACCENT: dict[Mode, str] = {"light": "#4a5a8a", "dark": "#5d73b8"}
LINK: dict[Mode, str] = {"light": ACCENT["light"], "dark": "#8fa3e0"}

Scale = list[tuple[float, str]]


def _evenly_spaced(*colours: str) -> Scale:
    """A scale of evenly spaced colours."""
    return [(i / (len(colours) - 1), colour) for i, colour in enumerate(colours)]


# Weight relative to uniform. Rows that count more have stronger colours: pale blue counts less,
# the page's own tone as much, strong orange more.
DIVERGING: dict[Mode, Scale] = {
    "light": _evenly_spaced("#8fb4ea", "#c3d7f3", "#f3f1ed", "#ec9067", "#8c2304"),
    "dark": _evenly_spaced("#2a5496", "#26406b", "#272b35", "#c8541f", "#ffc48f"),
}
# The same for solid things under light and for points: like areas, but far from the background
# at every weight.
COLUMNS: dict[Mode, Scale] = {
    "light": [(0.0, "#5b94e9"), (0.5, "#888e9b"), (0.75, "#dd6722"), (1.0, "#c22c06")],
    "dark": [(0.0, "#3d6fbe"), (0.5, "#687084"), (0.75, "#dd6a2c"), (1.0, "#ffcd9c")],
}
# The map of a buffer: the middle is far from the page's background, which means no rows.
BLUE_TO_ORANGE: dict[Mode, Scale] = {
    "light": _evenly_spaced("#0b3c8c", "#4f8fe0", "#d3d0cb", "#ee7f3c", "#a82a00"),
    "dark": _evenly_spaced("#1c57b8", "#4a83d6", "#5a606d", "#e8762f", "#ffd2a1"),
}
RISING: dict[Mode, Scale] = {
    "light": _evenly_spaced("#440154", "#3b528b", "#21918c", "#5ec962", "#d8c916"),
    "dark": _evenly_spaced("#5a3a8f", "#4a70b5", "#21a18c", "#7ad151", "#fde725"),
}
_RAMP: dict[Mode, tuple[float, float]] = {"light": (0.0, 0.6), "dark": (0.32, 1.0)}
"""the part of viridis that stands out from the page"""


def ramp(count: int, mode: Mode) -> list[str]:
    """`count` colours of a scale for ordered groups, as `#rrggbb`, the lowest first."""
    from plotly.colors import sample_colorscale  # here: servers need no plotly

    at = np.linspace(*_RAMP[mode], count).tolist()
    shades = np.array(sample_colorscale("Viridis", at, colortype="tuple"))
    return ["#" + bytes(colour).hex() for colour in (255 * shades).round().astype(np.uint8)]


def learner_colour(learner: str) -> str:
    """The colour of a learner, the same in every figure; neutral for an unknown learner."""
    if learner in BASELINE_COLOURS:
        return BASELINE_COLOURS[learner]
    if learner not in LEARNERS:
        return NEUTRAL
    if colour := LEARNERS[learner].colour:
        return colour
    newcomers = [name for name, entry in LEARNERS.items() if not entry.colour]
    return _SPARE_COLOURS[newcomers.index(learner) % len(_SPARE_COLOURS)]


def learner_symbol(learner: str) -> str:
    """The marker of a learner, a second cue besides its colour."""
    names = list(LEARNER_COLOURS)
    return SYMBOLS[names.index(learner) % len(SYMBOLS)] if learner in names else "x"


def rgb(colour: str) -> tuple[int, int, int]:
    """`#rrggbb` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def mix(colour: str, other: str, share: float) -> str:
    """`#rrggbb` with a `share` of another colour in it."""
    parts = zip(rgb(colour), rgb(other), strict=True)
    return "#" + "".join(f"{round(a + share * (b - a)):02x}" for a, b in parts)


@cache
def shades(colour: str) -> list[str]:
    """The shades of a colour, from dark to pale, that a line may have on both backgrounds."""
    steps = np.linspace(0, 1, 51)
    every = [mix("#000000", colour, share) for share in steps]
    every += [mix(colour, "#ffffff", share) for share in steps[1:]]
    return [
        one for one in every if min(contrast(one, b) for b in BACKGROUND.values()) >= LEAST_CONTRAST
    ]


def contrast(first: str, second: str) -> float:
    """The contrast of two colours, from 1 to 21 (WCAG 2)."""
    low, high = np.sort(linear_light([rgb(first), rgb(second)]) @ (0.2126, 0.7152, 0.0722))
    return float((high + 0.05) / (low + 0.05))


def linear_light(colours: ArrayLike) -> NDArray[np.float64]:
    """sRGB colours, 0 to 255, as intensities of light, 0 to 1 (IEC 61966-2-1)."""
    share = np.asarray(colours, np.float64) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def with_alpha(colour: str, alpha: float) -> str:
    """`#rrggbb` as a CSS colour of opacity `alpha`."""
    red, green, blue = rgb(colour)
    return f"rgba({red}, {green}, {blue}, {alpha:g})"


def scale_colours(
    share: NDArray[np.float64], scale: Sequence[tuple[float, str]]
) -> NDArray[np.uint8]:
    """Positions in [0, 1] as colours: (...,) -> (..., 3), linear between the scale's stops."""
    stops = np.array([at for at, _ in scale])
    colours = np.array([rgb(colour) for _, colour in scale], np.float64)
    channels = [np.interp(share, stops, colours[:, c]) for c in range(3)]
    return np.stack(channels, -1).round().astype(np.uint8)


def streamlit_options(theme: Mode | None) -> dict[str, Any]:
    """Streamlit's theme settings; without a `theme` the browser's preference decides."""
    options: dict[str, Any] = {"theme.base": theme} if theme else {}
    options |= {
        "theme.baseRadius": "medium",
        "theme.paddingTop": "1rem",
        "theme.paddingBottom": "2rem",
        "theme.baseFontSize": 15,
        "theme.headingFontWeights": [650, 600, 600],
        "theme.headingFontSizes": ["1.7rem", "1.25rem", "1.05rem"],
        "theme.metricValueFontSize": "1.35rem",
        "theme.chartCategoricalColors": list(LEARNER_COLOURS.values()),
    }
    for mode in (theme,) if theme else ("light", "dark"):
        section = "theme" if theme else f"theme.{mode}"
        options |= {
            f"{section}.primaryColor": ACCENT[mode],
            f"{section}.backgroundColor": BACKGROUND[mode],
            f"{section}.secondaryBackgroundColor": SURFACE[mode],
            f"{section}.textColor": TEXT[mode],
            f"{section}.borderColor": BORDER[mode],
            f"{section}.linkColor": LINK[mode],
            f"{section}.codeTextColor": TEXT[mode],
        }
    return options
