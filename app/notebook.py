"""The pages' figures for notebooks: the result of `tom.studio.show`."""

import plotly.graph_objects as go

from app.figures.curves import group_curves
from app.figures.weights import median_profiles, over_fits, weight_profile
from tom.analysis.curves import Curve, curve_points, groups
from tom.frames import Run, Weighing

RETURN = "eval/return"


class Figures(dict[str, go.Figure]):
    """Figures by name; a notebook shows them below each other with their names."""

    def _ipython_display_(self) -> None:
        from IPython.display import Markdown, display  # installed if this is called

        for name, figure in self.items():
            display(Markdown(f"**{name}**"))
            display(figure)


def figures(shown: Run | Weighing, height: int) -> Figures:
    """The figures that the pages show of a run or a weighing."""
    if isinstance(shown, Weighing):
        share = shown.random_share
        return Figures(profiles=median_profiles(shown.by_learner(), share, height))
    reader, found = shown.reader, Figures()
    env, learner, profiles = reader.env, reader.learner, reader.profiles()
    points = curve_points(shown.metrics.reset_index(), RETURN)
    curve = Curve(shown.name, env, learner, reader.preset, reader.seed, *points)
    if len(curve.step):
        found["return"] = group_curves(groups([curve]), RETURN, height, singles=False)
    if len(profiles.env_step):
        found["every fit"] = over_fits([("", curve, profiles)], "light", height)
        found["the last fit"] = weight_profile(profiles.bins[-1], learner, height)
    return found
