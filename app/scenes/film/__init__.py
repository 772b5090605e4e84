"""Films of a run as HTML files whose Content-Security-Policy forbids any request.

The cinema tells a run's story on one timeline; another film has an episode between two predictions.
"""

import html
import json
from functools import cache
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from app.figures.base import OCTAVES
from app.scenes.film.story import travelling
from app.theme import (
    BACKGROUND,
    BORDER,
    COLUMNS,
    DIVERGING,
    NEUTRAL,
    SURFACE,
    TEXT,
    Mode,
    learner_colour,
)
from tom.envs import Task
from tom.envs.scene import Model

SECONDS = 60.0
WIDTH, HEIGHT = 1280, 720
SPEED = 0.25
APART = 0.75
"""metres between two robots"""
AS_IT_IS = "x1"
_HERE = Path(__file__).parent
_NOTHING = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"
"""the Content-Security-Policy: no external resources"""
_MODES: tuple[Mode, ...] = ("light", "dark")


def cinema(story: dict[str, Any], learner: str, mode: Mode, seconds: float = SECONDS) -> str:
    """The page that plays a story (`app.scenes.film.story`) in `seconds`."""
    told = {**story, "seconds": seconds, "mode": mode, "look": look(learner)}
    return document(story["title"], "cinema.js", told, mode)


def document(title: str, script: str, told: dict[str, Any], mode: Mode) -> str:
    """One self-contained HTML page: the canvas, its controls, the scripts and their data."""
    # Escape characters that would end a script element or begin a comment in it.
    data = json.dumps(told, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    scripts = "\n".join(_asset(name) for name in ("canvas.js", "mp4.js", script))
    return (
        f'<!doctype html><html lang="en" data-mode="{mode}"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_NOTHING}">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_asset('film.css')}</style></head><body>"
        f'<canvas width="{WIDTH}" height="{HEIGHT}" role="img" '
        f'aria-label="{html.escape(title)}"></canvas>'
        '<div class="controls"><button type="button" aria-label="play or pause">▶</button>'
        '<input type="range" min="0" max="1" step="any" value="0" aria-label="time">'
        '<button type="button" class="save" hidden title="save the film as MP4">MP4</button></div>'
        f"<script>const TOLD = {data};\n{scripts}</script></body></html>"
    )


def look(learner: str) -> dict[str, Any]:
    """The studio's colours for both modes."""
    return {
        mode: {
            "background": BACKGROUND[mode],
            "surface": SURFACE[mode],
            "text": TEXT[mode],
            "border": BORDER[mode],
            "neutral": NEUTRAL,
            "learner": learner_colour(learner),
            "map": DIVERGING[mode],
            "points": COLUMNS[mode],
            "octaves": OCTAVES,
        }
        for mode in _MODES
    }


@cache
def _asset(name: str) -> str:
    return (_HERE / name).read_text()


def ghosts(
    drawn: tuple[Task, Model],
    kept: dict[str, NDArray],
    factor: float,
    name: str,
    learner: str,
    mode: Mode,
) -> str:
    """The page that plays the real robot in the middle and the two ghosts beside it.

    `drawn` is the task and its robot's model, `kept` the arrays of `ghosts.npz`, `name` the name of
    the brushed model.
    """
    robots = [
        _robot(drawn, kept["real"], "real", "#5b6577" if mode == "light" else "#aeb7c8", 0.0, 1.0),
        _robot(drawn, kept[AS_IT_IS], "as it is", COLUMNS[mode][0][1], -APART, 0.8),
        _robot(drawn, kept[f"x{factor:g}"], name, COLUMNS[mode][2][1], APART, 0.8),
    ]
    told = {"mode": mode, "look": look(learner), "robots": robots, "speed": SPEED}
    told |= {"dt": float(kept["dt"]), "octaves": OCTAVES}
    return document(f"Two ghosts: as it is, and {name}", "ghosts.js", told, mode)


def _robot(
    drawn: tuple[Task, Model], qpos: NDArray, name: str, colour: str, shift: float, alpha: float
) -> dict[str, Any]:
    style = {"name": name, "colour": colour, "shift": shift, "alpha": alpha}
    return style | travelling(*drawn, qpos)
