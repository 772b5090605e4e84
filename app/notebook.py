"""The pages' figures for notebooks: the result of `tom.studio.show`."""

import numpy as np
import plotly.graph_objects as go

from app.data import regions
from app.data.buffer import Floats, rows_at
from app.figures.base import steps_in_words
from app.figures.curves import run_curves
from app.figures.probe import probe_profiles
from app.figures.regions import apart_bars, cell_map
from app.figures.weights import effective_sample, weight_map, weight_profile
from app.theme import learner_label
from tom.analysis import planes
from tom.analysis.curves import Curve, curve_points
from tom.frames import Run, Weighing
from tom.record.task_record import dimension_names

RETURN = "eval/return"
HEAVIEST = 0.01
"""the share of rows of which it is said what sets them apart"""


class Figures(dict[str, go.Figure]):
    """Figures by name; a notebook shows them below each other with their names."""

    def _ipython_display_(self) -> None:
        from IPython.display import Markdown, display  # installed if this is called

        for name, figure in self.items():
            display(Markdown(f"**{name}**"))
            display(figure)


def figures(shown: Run | Weighing, height: int) -> Figures:
    """The figures that the pages show of a run or a weighing."""
    return _of_run(shown, height) if isinstance(shown, Run) else _of_weighing(shown, height)


def _of_run(run: Run, height: int) -> Figures:
    reader, profiles = run.reader, run.reader.profiles()
    env, learner = reader.env, reader.learner
    step, value = curve_points(run.metrics.reset_index(), RETURN)
    figures = Figures()
    if len(step):
        preset = str(reader.config.get("preset", "?"))
        curve = Curve(run.name, env, learner, preset, reader.seed, step, value)
        figures["return"] = run_curves([curve], RETURN, height, legend=False)
    if len(profiles.env_step):
        x = steps_in_words([env])
        figures |= {
            "every fit": weight_map(profiles, "light", height, relative=True, x=x),
            "the last fit": weight_profile(profiles.bins[-1], learner, height),
            "effective sample": effective_sample(profiles, learner, height, x),
        }
    return figures


def _of_weighing(weighing: Weighing, height: int) -> Figures:
    by_learner, share = weighing.by_learner(), weighing.random_share
    figures = Figures()
    figures["profiles"] = probe_profiles(by_learner, share, height, log=False)
    first = str(weighing.weights.columns[0])
    if weighing.recorded is not None:
        weight = weighing.weights[first].to_numpy(np.float64)
        figures |= _regions(weighing, first, weight, height)
    return figures


def _regions(weighing: Weighing, column: str, weight: Floats, height: int) -> Figures:
    learner, _, seed = column.rpartition("-s")
    assert weighing.recorded is not None
    version = np.arange(len(weight))
    rows = rows_at(weighing.recorded, version, weight, len(weight))
    assert rows is not None
    name = f"{learner_label(learner)} s{seed}"
    mask = regions.heaviest(weight, HEAVIEST)
    names, actions = dimension_names(str(weighing.report["env"]), rows.rows)
    table, described = planes.features(rows.rows, names, actions)
    plane = planes.contrast(table, weight, described)
    xy = plane.project(table)
    gaps = regions.apart(rows, mask, names + actions)
    return Figures(
        {
            f"the data by {name}": cell_map(xy, plane.names, weight, "light", height, column),
            f"what sets {name}'s heaviest 1 % apart": apart_bars(gaps, height),
        }
    )
