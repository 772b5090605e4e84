"""Road-and-rocks: metrics of weights and models, the planner, and the pictures in a record."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.data.transitions import TensorTransitions
from tom.dynamics.linear import LinearModel
from tom.events import Episode
from tom.exams.diagnostics import weight_metrics
from tom.road import offline_data, task
from tom.road.offline_data import OfflineData, Steering

TEST_ROWS = 10_000  # fresh random transitions over the whole map
TEST_TRAJECTORIES = 10  # fresh expert trajectories
REFERENCE_EPISODES = 50
FIELD_POINTS = 21  # points of the displacement field along each side
SHOWN = 10  # trajectories of each kind in a record
GRID = 51
"""values are computed at GRID x GRID states and interpolated between them"""
LEVELS = 9
"""number of values tried in each action dimension"""
SWEEPS = 400
TOLERANCE = 1e-4


def held_out(road_map: task.RoadMap, generator: torch.Generator) -> dict[str, TensorTransitions]:
    """Fresh transitions of the real task: the expert's, and random ones on road and rocks."""
    expert = offline_data.drive(
        road_map, offline_data.noisy_expert(generator), TEST_TRAJECTORIES, generator
    )
    obs = torch.rand(TEST_ROWS, task.OBS_DIM, generator=generator)
    action = offline_data.random_steering(generator)(obs)
    rows = offline_data.transition(obs, action, task.step(road_map, obs, action, generator))
    inside = task.on_road(obs)
    return {
        "expert": TensorTransitions.join([offline_data.episode_rows(e) for e in expert]),
        "road": rows[inside],
        "rocks": rows[~inside],
    }


def model_errors(model: LinearModel, test: dict[str, TensorTransitions]) -> dict[str, float]:
    """Root mean squared distance between predicted and real next position, in full steps.

    The task's noise alone gives 0.07.
    """
    errors = {}
    for name, rows in test.items():
        error = model.next_obs(rows.obs, rows.action) - rows.next_obs
        errors[f"model/error_{name}"] = float(error.square().sum(-1).mean().sqrt()) / task.STEP
    return errors


def weight_shares(data: OfflineData, weights: Tensor) -> dict[str, float]:
    """The share of weight on the road, and the ratio of road to rocks among random rows.

    The ratio is NaN if no random row on the rocks has weight (footprint-only).
    """
    inside = task.on_road(data.rows.obs)
    mean_road = float(weights[inside & ~data.expert].mean())
    mean_rocks = float(weights[~inside & ~data.expert].mean())
    return {
        "weights/road_share": float(weights[inside].sum() / weights.sum()),
        "weights/road_ratio": mean_road / mean_rocks if mean_rocks > 0 else float("nan"),
        **weight_metrics(weights),
    }


def returns(episodes: Sequence[Episode]) -> tuple[float, float]:
    """Mean return and share of success."""
    success = [episode.info["success"] for episode in episodes]
    return float(np.mean([e.undiscounted_return for e in episodes])), float(np.mean(success))


def reference_returns(road_map: task.RoadMap, generator: torch.Generator) -> dict[str, float]:
    """The returns of uniform actions and of the noisy expert on this map."""
    steerings = {
        "random": offline_data.random_steering(generator),
        "expert": offline_data.noisy_expert(generator),
    }
    return {
        f"eval/return_{name}": returns(
            offline_data.drive(road_map, steer, REFERENCE_EPISODES, generator)
        )[0]
        for name, steer in steerings.items()
    }


# The planner: value iteration on a grid over the unit square, with known reward. It is cheap and
# has no optimisation noise, so its return in the real task measures only the model.


def plan(model: LinearModel, discount: float) -> Steering:
    """The planner's policy in a learnt model."""
    return planned(model.next_obs, task.reward, task.at_goal, discount)[1]


def interpolation(obs: Tensor) -> Callable[[Tensor], Tensor]:
    """Bilinear interpolation at B states (B, 2): from a table (GRID^2,) the values (B,)."""
    scaled = obs.clamp(0, 1) * (GRID - 1)
    low = scaled.floor().clamp(max=GRID - 2)
    (x, y), (u, v) = low.long().unbind(-1), (scaled - low).unbind(-1)
    first = y * GRID + x
    index = torch.stack([first, first + 1, first + GRID, first + GRID + 1])  # (4, B)
    share = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    return lambda value: (share * value[index]).sum(0)


def planned(
    predict: Callable[[Tensor, Tensor], Tensor],
    reward: Callable[[Tensor], Tensor],
    terminated: Callable[[Tensor], Tensor],
    discount: float,
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """V (GRID^2,), row by row, and the greedy policy: actions (B, 2) for obs (B, 2).

    V(s) = max_a r(s') + discount (1 - terminated(s')) V(s'), where `predict` is next_obs (B, 2)
    after obs and action, and the other two are of next_obs.
    """
    levels = torch.linspace(-1, 1, LEVELS)
    tried = torch.cartesian_prod(levels, levels)

    def look_ahead(obs: Tensor) -> Callable[[Tensor], Tensor]:
        """From a table of values, Q of every action at obs (B, 2): (LEVELS^2, B)."""
        next_obs = predict(obs.repeat(len(tried), 1), tried.repeat_interleave(len(obs), 0)).clamp(
            0, 1
        )
        gain, read = reward(next_obs), interpolation(next_obs)
        alive = discount * (1 - terminated(next_obs).float())
        return lambda value: (gain + alive * read(value)).view(len(tried), len(obs))

    axis = torch.linspace(0, 1, GRID)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    ahead, value = look_ahead(torch.stack([x, y], -1).reshape(-1, 2)), torch.zeros(GRID * GRID)
    for _ in range(SWEEPS):
        before, value = value, ahead(value).amax(0)
        if float((value - before).abs().max()) < TOLERANCE:
            break
    return value, lambda obs: tried[look_ahead(obs)(value).argmax(0)]


# Pictures: arrays described in docs/run-folder.md


def map_field(road_map: task.RoadMap) -> dict[str, NDArray]:
    line = np.array(task.CENTRE_LINE, np.float32)
    return {
        "centre_line": line,
        "road_half_width": np.array(task.HALF_WIDTH, np.float32),
        "start": np.array([*line[0], task.START_RADIUS], np.float32),
        "goal": np.array([*line[-1], task.GOAL_RADIUS], np.float32),
        "gain": road_map.gain.numpy(),
        "angle": road_map.angle.numpy(),
    }


def model_field(road_map: task.RoadMap, model: LinearModel) -> dict[str, NDArray]:
    """Real and modelled displacements under the expert's action, on a grid of points."""
    axis = (torch.arange(FIELD_POINTS) + 0.5) / FIELD_POINTS
    points = torch.cartesian_prod(axis, axis)
    action = task.expert_action(points)
    modelled = model.next_obs(points, action) - points
    true = task.displacement(road_map, points, action)
    arrays = {"points": points, "action": action, "true": true, "modelled": modelled}
    return {name: array.numpy() for name, array in arrays.items()}


def trajectory_field(expert: Sequence[Episode], learnt: Sequence[Episode]) -> dict[str, NDArray]:
    shown = {f"expert_{k}": episode.obs for k, episode in enumerate(expert[:SHOWN])}
    return shown | {f"learnt_{k}": episode.obs for k, episode in enumerate(learnt[:SHOWN])}
