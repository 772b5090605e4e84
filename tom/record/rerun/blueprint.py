"""The layout of a run in Rerun, which shows everything without a click."""

import rerun as rr
import rerun.blueprint as rrb

from tom.envs import ROAD
from tom.learners import LEARNERS

PROFILE = "weights/profile"
SCENE = "scene"
TRACKED = f"{SCENE}/place"  # moves along with the robot; the camera sits on it
ROBOT = f"{SCENE}/robot"
GHOST = f"{SCENE}/ghost"  # the robot as a model predicts it
GROUND = f"{SCENE}/ground"
MAP = "map"
CAR, GHOST_CAR = f"{MAP}/car", f"{MAP}/ghost"
REWARD = "reward"
OBSERVED = "observation"

FIT = "fit"  # the metrics of a single fit, as text

RETURN = {"Return": ("eval/return", "eval/return_max")}
POLICY = {"Policy: losses": ("critic/loss", "actor/loss")}
MODEL = {
    "Dynamics model: loss": ("model/train_nll", "model/holdout_nll", "model/holdout_nll_uniform"),
    "Weights": ("weights/ess", "weights/zeros", "weights/age_correlation"),
}


def blueprint(env: str, learner: str, *, drawn: bool = True) -> rrb.Blueprint:
    """Robot or maps and the weight profile on the left, curves on the right.

    If nothing can be `drawn`, curves of the observations replace the robot.
    """
    online = env != ROAD
    observed = _plot("Observations of the first evaluation episode", (f"{OBSERVED}/**",))
    picture = _maps() if not online else _robot() if drawn else observed
    profile = rrb.BarChartView(origin=PROFILE, name="Mean weight, oldest to newest transitions")
    own = LEARNERS[learner].charts if learner in LEARNERS else {}
    shown = {**RETURN, **MODEL, **POLICY, **own} if online else RETURN | POLICY
    plots = [_plot(name, paths) for name, paths in shown.items()]
    # Offline there is a single fit: its metrics are a table, not curves.
    text = [] if online else [rrb.TextDocumentView(origin=FIT, name="Fit")]
    left = rrb.Vertical(picture, profile, row_shares=[3, 2])
    return _without_panels(
        rrb.Horizontal(left, rrb.Vertical(*plots, *text), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="env_step", fps=100.0, play_state="following"),
    )


def episode_blueprint(env: str, drawn: bool = True, observed: int = 0) -> rrb.Blueprint:
    """One episode in real time, in a loop: the robot or the car, and the reward.

    If nothing can be `drawn`, curves of `observed` dimensions replace the robot.
    """
    name = "The episode; red: what the model imagines"
    picture = _map(name, ["$origin/**"]) if env == ROAD else _robot(name)
    if env != ROAD and not drawn:
        picture = _plot("Observations", tuple(f"{OBSERVED}/{i + 1}" for i in range(observed)))
    return _without_panels(
        rrb.Vertical(picture, _plot("Reward of each step", (REWARD,)), row_shares=[3, 1]),
        rrb.TimePanel(state="collapsed", timeline="replay", play_state="playing", loop_mode="all"),
    )


def _without_panels(views: rrb.Container, time: rrb.TimePanel) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        time,
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
    # A corner that lines rarely cross: returns rise, losses fall.
    corner = rrb.Corner2D.RightBottom if name in RETURN else rrb.Corner2D.RightTop
    # Points are always shown, because a metric with a single value has no line.
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ /{path}" for path in paths],
        name=name,
        axis_x=rrb.TimeAxis(view_range=everything),
        plot_legend=rrb.PlotLegend(corner),
        interaction=rrb.PlotInteraction(points_display="Always"),
    )
