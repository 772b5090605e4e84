"""An episode and its prediction by two models, as a film of robots."""

from typing import Any

from numpy.typing import NDArray

from app.figures.scales import OCTAVES
from app.scenes.film.page import document, look
from app.scenes.film.robots import travelling
from app.theme import COLUMNS, Mode
from tom.envs import Task
from tom.envs.scene import Model

SPEED = 0.25
APART = 0.75
"""metres between two robots"""
AS_IT_IS = "x1"


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
