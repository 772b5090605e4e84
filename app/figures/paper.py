"""A page's figure for a paper: drawn anew at the width of a column, as vectors, black on white.

The browser sends what it shows (`app/parts/plot/plot.js`): traces with plain numbers, axes with the
zoomed range, labels and lines.
"""

import html
import io
import re
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure

from app.figures.curves import HOLLOW_MARK, MARK, spread_apart
from app.theme import NEUTRAL

WIDTHS = {"one": 3.4, "two": 7.0}
"""inches of one and of two columns"""
KINDS = {"pdf": "application/pdf", "svg": "image/svg+xml", "png": "image/png"}
TEXT = 8  # points
EDGE = 0.04  # inches between what is drawn and the edge of the figure
ROWS = 30  # letters of a line of a label
LETTER, ROW = 0.062, 0.16  # inches of a letter, and of a row of the legend
LINE = 0.42  # points of a line for a pixel on the screen
DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-.", "longdash": (0, (8, 3)),
          "longdashdot": (0, (8, 3, 1, 3))}  # fmt: skip
SYMBOLS = {"circle": "o", "square": "s", "diamond": "D", "triangle-up": "^", "triangle-down": "v",
           "pentagon": "p", "x": "X", "diamond-wide": "d"}  # fmt: skip
STYLE: dict[Any, Any] = {
    "font.size": TEXT, "font.family": "sans-serif", "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.6, "xtick.major.width": 0.6,
    "ytick.major.width": 0.6, "legend.frameon": False, "pdf.fonttype": 42, "svg.fonttype": "none",
    "axes.unicode_minus": False,
}  # fmt: skip


def paper_figure(shown: Mapping[str, Any], width: str, kind: str) -> bytes:
    """The file of a figure: `width` is a key of `WIDTHS`, `kind` of `KINDS`.

    Raises ValueError, TypeError, KeyError or IndexError for what is no such figure.
    """
    if kind not in KINDS:
        raise ValueError(f"no format {kind!r}")
    inches = WIDTHS[width]
    # Remarks in the figure's corner are at the edge as well, but at no height of the y axis.
    notes = [one for one in shown["annotations"] if one["xref"] == "paper" and one["x"] >= 1]
    labels = [one for one in notes if one["yref"] != "paper"]
    keyed = [t for t in shown["traces"] if t["showlegend"]] if shown["legend"] else []
    longest = max((len(t["name"]) for t in keyed), default=1)
    beside = max(1, int((inches - 0.5) / (0.45 + LETTER * longest)))
    top = ROW * -(-len(keyed) // beside)
    height = top + 0.5 + inches * min(max(float(shown["ratio"]), 0.3), 1.2) * 0.8
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(inches, height))
        axes = {name: _axes(figure, pair, inches) for name, pair in shown["axes"].items()}
        drawn = [_trace(axes[trace["axes"]], trace) for trace in shown["traces"]]
        first = next(iter(axes.values()))
        for shape in shown["shapes"]:
            on = axes.get(shape.get("axes"), first)
            flat = shape["y0"] == shape["y1"]
            across, at = (on.axhline, shape["y0"]) if flat else (on.axvline, shape["x0"])
            across(at, color=NEUTRAL, linewidth=0.6, linestyle=DASHES.get(shape["dash"], "-"))
        _labels(first, labels, 72 * (height - 0.5 - top))
        for name, pair in shown["axes"].items():
            (left, right), over = pair["x"]["domain"], pair["y"]["domain"][1]
            for one in shown["annotations"]:  # names of columns
                at_top = one["yref"] == "paper" and min(one["y"], over) > 0.99
                if at_top and left < one["x"] < right:
                    axes[name].set_title(_plain_text(one["text"]), fontsize=TEXT)
        _fit(figure, axes, shown["axes"], top)
        if keyed:
            pairs = zip(shown["traces"], drawn, strict=True)
            handles = [one for trace, one in pairs if trace["showlegend"]]
            figure.legend(
                handles, [_plain_text(trace["name"]) for trace in keyed], loc="upper left",
                ncols=beside, fontsize=TEXT, bbox_to_anchor=(0.02, 1), borderaxespad=0.1,
                handlelength=1.6, columnspacing=1,
            )  # fmt: skip
        file = io.BytesIO()
        figure.savefig(file, format=kind, dpi=600)
    return file.getvalue()


def _fit(figure: Figure, axes: Mapping[str, Axes], pairs: Mapping[str, Any], top: float) -> None:
    """Give every axes its share of what its labels and the `top` inches leave of the figure."""
    width, height = figure.get_size_inches()
    left, bottom, right, over = 0.3, 0.3, 0.1, 0.1 + top
    for _ in range(3):  # labels move with the axes
        across, up = width - left - right, height - bottom - over
        for name, pair in pairs.items():
            (x0, x1), (y0, y1) = pair["x"]["domain"], pair["y"]["domain"]
            place = (left + x0 * across, bottom + y0 * up, (x1 - x0) * across, (y1 - y0) * up)
            axes[name].set_position(tuple(np.divide(place, (width, height) * 2)))
        figure.draw_without_rendering()
        box = figure.get_tightbbox()
        left, bottom = left + EDGE - box.x0, bottom + EDGE - box.y0
        right, over = right + EDGE + box.x1 - width, over + EDGE + box.y1 - height + top
        left, right = (min(margin, 0.65 * width) for margin in (left, right))


def _axes(figure: Figure, pair: Mapping[str, Any], inches: float) -> Axes:
    """The axes of an x and a y axis, not yet in their place."""
    x, y = pair["x"], pair["y"]
    axes = figure.add_axes((0, 0, 1, 1), label=f"{x['domain']} {y['domain']}")
    for axis, name in ((x, "x"), (y, "y")):
        if axis["type"] == "log":
            axes.set(**{f"{name}scale": "log"})
        ends = [10**end if axis["type"] == "log" else end for end in axis["range"]]
        title = fill(_plain_text(axis["title"]), int(12 * inches) if name == "x" else 60)
        if axis["tickvals"]:
            lines = (_plain_text(word).split("\n") for word in axis["ticktext"])
            words = ["\n".join(fill(line, ROWS) for line in of) for of in lines]
            axes.set(**{f"{name}ticks": axis["tickvals"], f"{name}ticklabels": words})
            axes.minorticks_off()
        axes.set(**{f"{name}lim": ends, f"{name}label": title})  # ticks beyond them move them
    if x["type"] != "log" and max(map(abs, x["range"])) >= 10_000:
        axes.xaxis.set_major_formatter(lambda at, _: f"{at / 1000:g}k")
    if y["domain"][0] > 0.01:  # another one is below it, on the same x axis
        axes.tick_params(labelbottom=False)
        axes.set_xlabel("")
    if x["domain"][0] > 0.01:  # another one is left of it, on the same y axis
        axes.tick_params(labelleft=False)
    axes.grid(axis="y", linewidth=0.3, alpha=0.5)
    return axes


def _trace(axes: Axes, trace: Mapping[str, Any]) -> Any:
    """Draw a trace, and return what stands for it in a legend."""
    x, y = _numbers(trace["x"]), _numbers(trace["y"])
    if trace["type"] == "heatmap":
        z = np.asarray(trace["z"], np.float64)
        stops = [(at, _rgba(colour)) for at, colour in trace["colorscale"]]
        drawn = axes.pcolormesh(
            _edges(x, z.shape[1]), _edges(y, z.shape[0]), z, rasterized=True,
            cmap=LinearSegmentedColormap.from_list("page", stops),
            vmin=trace["zmin"], vmax=trace["zmax"],
        )  # fmt: skip
        if trace["ticks"]:  # of several alike one has the scale
            beside = axes.inset_axes((1.02, 0, 0.03, 1))
            bar = axes.figure.colorbar(drawn, cax=beside)
            bar.set_ticks(trace["ticks"]["tickvals"], labels=trace["ticks"]["ticktext"])
        return drawn
    if trace["type"] == "bar":
        gap = np.diff(x).min() if len(x) > 1 else 1.0
        return axes.bar(x, y, width=gap, color=_rgba(trace["colour"]), linewidth=0)
    if trace["type"] == "waterfall":
        moves = np.where(np.array(trace["measure"]) == "relative", y, 0)
        rises, falls, stands = map(_rgba, trace["tints"])
        colours = [stands if not move else rises if move > 0 else falls for move in moves]
        return axes.bar(x, y, bottom=(np.cumsum(moves) - moves) * (moves != 0), color=colours)
    if trace["fill"]:
        return axes.fill(x, y, color=_rgba(trace["fill"]), linewidth=0)[0]
    for name, bars in (("xerr", trace["bars"]), ("yerr", trace.get("upright"))):
        if bars:
            ends: Any = {name: np.array([bars["arrayminus"], bars["array"]], np.float64)}
            axes.errorbar(x, y, **ends, fmt="none", ecolor=_rgba(bars["color"]), elinewidth=0.8)
    if trace["marks"]:  # a symbol and a colour for each point
        points = []
        for at, height, (symbol, colour) in zip(x, y, trace["marks"], strict=False):
            name, colour = symbol.removesuffix("-open"), _rgba(colour)
            inside = "white" if symbol != name else colour
            style = {"color": colour, "markersize": 4, "markerfacecolor": inside}
            points += axes.plot(at, height, SYMBOLS[name], **style)
        return points[0]
    lines, marks = "lines" in trace["mode"], "markers" in trace["mode"]
    return axes.plot(
        x, y, linewidth=LINE * trace["width"], linestyle=DASHES[trace["dash"]] if lines else "",
        drawstyle="steps-mid" if trace["shape"] == "hvh" else "default",
        marker=SYMBOLS.get(trace["symbol"], "o") if marks else "", markeredgewidth=0,
        markersize=LINE * trace["size"], alpha=trace["opacity"], color=_rgba(trace["colour"]),
    )[0]  # fmt: skip


def _labels(axes: Axes, labels: Sequence[Mapping[str, Any]], points: float) -> None:
    """The names of lines at the right of axes of so many points of height, none over another."""
    low, high = axes.get_ylim()
    inverse = axes.transData + axes.transAxes.inverted()
    at = [inverse.transform((0, one["y"]))[1] for one in labels]
    if axes.get_yscale() == "log":  # a label's place on a log axis is already a logarithm
        at = [(one["y"] - np.log10(low)) / (np.log10(high) - np.log10(low)) for one in labels]
    for one, place in zip(labels, spread_apart(points * np.array(at), 1.25 * TEXT), strict=True):
        height, colour = place / points, re.search(r"color:(#[0-9a-fA-F]{6})", one["text"])
        if colour:
            parts = [(colour[1], 2.0)] + [("white", 1.0)] * (HOLLOW_MARK in one["text"])
            for part, width in parts:
                axes.plot(
                    (1.015, 1.035), (height, height), transform=axes.transAxes, clip_on=False,
                    color=part, linewidth=width,
                )  # fmt: skip
        axes.text(1.05, height, _plain_text(one["text"]), transform=axes.transAxes, va="center")


def _numbers(values: Sequence[Any]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _edges(places: np.ndarray, count: int) -> np.ndarray:
    """The edges (n + 1,) of n cells, from their centres or from edges as they are."""
    if len(places) == count + 1:
        return places
    if count == 1:
        return np.array([places[0] - 0.5, places[0] + 0.5])
    between = (places[1:] + places[:-1]) / 2
    return np.concatenate([[2 * places[0] - between[0]], between, [2 * places[-1] - between[-1]]])


def _rgba(colour: str) -> tuple[float, float, float, float]:
    parts = re.fullmatch(r"rgba?\(([^)]*)\)", colour)
    if parts is None:
        return to_rgba(colour)
    red, green, blue, *alpha = (float(part) for part in parts[1].split(","))
    return red / 255, green / 255, blue / 255, alpha[0] if alpha else 1.0


def _plain_text(label: str) -> str:
    """A label without its HTML and the mark of its colour."""
    text = re.sub(f"<[^>]*>|[{MARK}{HOLLOW_MARK}] ?", "", label.replace("<br>", "\n"))
    return html.unescape(text).strip()
