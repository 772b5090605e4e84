"""How a run is laid out in Rerun: everything is there without a click."""

import rerun as rr
import rerun.blueprint as rrb

from tom.envs import ENVS

PROFILE = "weights/profile"
SCENE = "scene"
TRACKED = f"{SCENE}/place"  # moves along with the robot; the camera sits on it
ROBOT = f"{SCENE}/robot"
GROUND = f"{SCENE}/ground"
MAP = "map"

PLOTS = {
    "Return": ("eval/return", "eval/return_max", "planner/return"),
    "Dynamics model: loss": (
        "model/train_nll",
        "model/holdout_nll",
        "model/holdout_nll_uniform",
        "model/error_road",
        "model/error_rocks",
        "model/error_expert",
    ),
    "Policy: losses": ("critic/loss", "actor/loss"),
    "Weights": ("weights/ess", "weights/zeros", "weights/age_correlation", "weights/road_share"),
    "TOM: discriminator and dual Q": ("discriminator/loss", "dual/loss", "dual/q_mean"),
}


def blueprint(env: str) -> rrb.Blueprint:
    """Robot or map and the weight profile on the left, curves on the right."""
    picture = _robot() if env in ENVS else _map()
    profile = rrb.BarChartView(origin=PROFILE, name="Mean weight, oldest to newest transitions")
    plots = rrb.Vertical(*(_plot(name, paths) for name, paths in PLOTS.items()))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(picture, profile, row_shares=[3, 2]), plots, column_shares=[3, 2]
        ),
        rrb.TimePanel(state="collapsed", timeline="env_step", fps=100.0, play_state="following"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="collapsed"),
    )


def _robot() -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=TRACKED,
        contents=f"/{SCENE}/**",
        name="First evaluation episode",
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=(0.6, -4.0, 1.4), look_target=(0.0, 0.0, 0.8)),
    )


def _map() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=f"/{MAP}",
        name="Road and rocks",
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.05, 1.05], y_range=[-1.05, 0.05]),
    )


def _plot(name: str, paths: tuple[str, ...]) -> rrb.TimeSeriesView:
    everything = rr.TimeRange(
        start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()
    )
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ /{path}" for path in paths],
        name=name,
        axis_x=rrb.TimeAxis(view_range=everything),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )
