"""How a run is laid out in Rerun: everything is there without a click."""

import rerun as rr
import rerun.blueprint as rrb

from tom.envs import ENVS

PROFILE = "weights/profile"
SCENE = "scene"
TRACKED = f"{SCENE}/place"  # moves along with the robot; the camera sits on it
ROBOT = f"{SCENE}/robot"
GHOST = f"{SCENE}/ghost"  # what a model makes of the robot
GROUND = f"{SCENE}/ground"
MAP = "map"
CAR, GHOST_CAR = f"{MAP}/car", f"{MAP}/ghost"
REWARD = "reward"

FIT = "fit"  # what a single fit measured, as text

RETURN = {"Return": ("eval/return", "eval/return_max")}
POLICY = {"Policy: losses": ("critic/loss", "actor/loss")}
MODEL = {
    "Dynamics model: loss": ("model/train_nll", "model/holdout_nll", "model/holdout_nll_uniform"),
    "Weights": ("weights/ess", "weights/zeros", "weights/age_correlation"),
}
TOM = {"TOM: discriminator and dual Q": ("discriminator/loss", "dual/loss", "dual/q_mean")}


def blueprint(env: str, learner: str) -> rrb.Blueprint:
    """Robot or maps and the weight profile on the left, curves on the right."""
    online = env in ENVS
    picture = _robot() if online else _maps()
    profile = rrb.BarChartView(origin=PROFILE, name="Mean weight, oldest to newest transitions")
    shown = (
        RETURN | MODEL | POLICY | (TOM if learner == "tom" else {}) if online else RETURN | POLICY
    )
    plots = [_plot(name, paths) for name, paths in shown.items()]
    # Offline there is one fit: its numbers are a table, not curves.
    text = [] if online else [rrb.TextDocumentView(origin=FIT, name="Fit")]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(picture, profile, row_shares=[3, 2]),
            rrb.Vertical(*plots, *text),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="env_step", fps=100.0, play_state="following"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="collapsed"),
    )


def episode_blueprint(env: str) -> rrb.Blueprint:
    """One episode in its own time, again and again: the robot or the car, and the reward."""
    name = "The episode; red: what the model imagines"
    picture = _robot(name) if env in ENVS else _map(name, ["$origin/**"])
    return rrb.Blueprint(
        rrb.Vertical(picture, _plot("Reward of each step", (REWARD,)), row_shares=[3, 1]),
        rrb.TimePanel(state="collapsed", timeline="replay", play_state="playing", loop_mode="all"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="collapsed"),
    )


def _robot(name: str = "First evaluation episode") -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=TRACKED,
        contents=f"/{SCENE}/**",
        name=name,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=(0.4, -2.6, 1.1), look_target=(0.0, 0.0, 0.65)),
    )


def _maps() -> rrb.Horizontal:
    arrows = [f"/{MAP}/{name}" for name in ("true", "modelled")]
    weights = ["$origin/**", *(f"- {path}" for path in arrows)]
    ground = [f"/{MAP}/{name}" for name in ("edge", "road")]
    return rrb.Horizontal(
        _map("Weights: red counts most", weights),
        _map("Steps: true green, modelled red", [f"+ {p}" for p in (*ground, *arrows)]),
    )


def _map(name: str, contents: list[str]) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=f"/{MAP}",
        contents=contents,
        name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.05, 1.05], y_range=[-1.05, 0.05]),
    )


def _plot(name: str, paths: tuple[str, ...]) -> rrb.TimeSeriesView:
    everything = rr.TimeRange(
        start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()
    )
    # Where the lines seldom are: returns rise, losses fall.
    corner = rrb.Corner2D.RightBottom if name in RETURN else rrb.Corner2D.RightTop
    # A metric with one value yet is a point and no line: points are shown always.
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ /{path}" for path in paths],
        name=name,
        axis_x=rrb.TimeAxis(view_range=everything),
        plot_legend=rrb.PlotLegend(corner),
        interaction=rrb.PlotInteraction(points_display="Always"),
    )
