"""The studio's figures from Python: `tom.studio.show`.

Figures belong to the studio (`app`), a package that the backend never imports. Like `tom studio`,
this loads it by name, and only when a figure is requested.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from tom.frames import Run, Weighing

FIGURES = "app.notebook"


def show(shown: Run | Weighing, height: int = 400) -> Mapping[str, Any]:
    """The studio's Plotly figures of a run or a weighing by name; Jupyter displays them all.

    For a run: `return`, and the weights of `every fit` and of `the last fit`. For a weighing: the
    learners' `profiles`.
    """
    return import_module(FIGURES).figures(shown, height)
