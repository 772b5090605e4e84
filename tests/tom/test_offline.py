from typing import Any

import numpy as np
import pytest
import torch

from tom import offline
from tom.config import RoadConfig
from tom.events import Event, Field, Metrics, Weights
from tom.road import task
from tom.road.baselines import BASELINES
from tom.road.measure import weight_shares
from tom.training.presets import resolve

TINY: dict[str, Any] = {
    "steps": 60,
    "fit_every": 30,
    "random_transitions": 1000,
    "expert_trajectories": 3,
    "evaluation": {"every": 20, "episodes": 3},
    "rollout": {"starts": 100},
    "sac": {"hidden": 16, "batch_size": 64},
    "tom": {"discriminator_steps": 20, "q_steps": 20, "q_hidden": 16, "action_samples": 2},
}


def tiny(learner: str, **changes: Any) -> RoadConfig:
    return RoadConfig(learner=learner).but(**TINY).but(**changes)


def metrics(events: list[Event]) -> dict[str, float]:
    values: dict[str, float] = {}
    for event in events:
        if isinstance(event, Metrics):
            values |= event.values
    return values


def test_pictures_hold_what_the_run_folder_promises():
    events = offline.Offline(tiny("tom")).events()
    arrays = {(e.name, e.env_step): e.arrays for e in events if isinstance(e, Field)}
    map_arrays = arrays["map", 0]
    assert {name: array.shape for name, array in map_arrays.items()} == {
        "centre_line": (3, 2),
        "road_half_width": (),
        "start": (3,),
        "goal": (3,),
        "gain": (10, 10),
        "angle": (10, 10),
    }
    model = arrays["model", 60]
    assert {array.shape for array in model.values()} == {(441, 2)}
    inside = np.abs(model["points"][:, 1] - 0.12) < 0.08
    inside &= (model["points"][:, 0] > 0.1) & (model["points"][:, 0] < 0.8)
    np.testing.assert_allclose(model["true"][inside], 0.04 * model["action"][inside], atol=1e-6)
    paths = arrays["trajectories", 60]
    assert set(paths) == {f"{kind}_{k}" for kind in ("expert", "learnt") for k in range(3)}
    assert np.hypot(*(paths["expert_0"][-1] - map_arrays["goal"][:2])) <= map_arrays["goal"][2]


def test_mle_weighs_all_rows_equally_and_learns_a_wrong_road():
    values = metrics(_until_optimised(resolve("road-and-rocks", "mle", "smoke")))
    assert values["weights/road_ratio"] == pytest.approx(1.0)
    assert 0.25 < values["weights/road_share"] < 0.35
    assert values["weights/ess"] == pytest.approx(1.0)
    assert values["model/error_expert"] > 0.9  # a full step off: it goes the wrong way
    assert values["planner/success"] == 0


def test_tom_finds_the_road_in_seconds():
    """A short version of the acceptance: fewer steps of discriminator and dual."""
    values = metrics(_until_optimised(resolve("road-and-rocks", "tom", "smoke")))
    assert values["weights/road_ratio"] > 5
    assert values["weights/road_share"] > 0.85
    assert values["model/error_expert"] < 0.3
    assert values["model/error_rocks"] > 1.2  # it gives up the rocks for it
    assert values["planner/success"] >= 0.9
    assert values["planner/return"] > -25


@pytest.mark.parametrize(("first", "drives"), [(False, True), (True, False)])
def test_pmac_follows_the_order_of_storage(first: bool, drives: bool):
    config = resolve("road-and-rocks", "pmac", "smoke", {"expert_first": first})
    values = metrics(_until_optimised(config))
    assert (values["planner/success"] >= 0.9) is drives
    assert (values["model/error_expert"] < 0.3) is drives


@pytest.mark.parametrize("name", ["expert-only", "footprint-only"])
def test_baselines_weigh_only_the_rows_they_are_named_after(name: str):
    run = offline.Offline(tiny(name))
    weights = run.weigh(run.context()).weights
    chosen = run.data.expert if name == "expert-only" else run.data.footprint
    assert torch.equal(weights > 0, chosen)
    assert weights.mean().item() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "labels-swapped" else pytest.mark.slow)
        for name in BASELINES
    ],
)
def test_a_baseline_trains_to_the_end_with_the_weights_it_began_with(name: str):
    events = list(offline.Offline(tiny(name)).events())
    first, *later = (e for e in events if isinstance(e, Weights))
    assert [e.env_step for e in later] == [30, 60]
    assert all(np.array_equal(e.weight, first.weight) for e in later)


def test_a_discriminator_alone_also_finds_the_road_and_swapped_labels_do_not():
    changes = {"random_transitions": 4000, "tom": {"discriminator_steps": 200, "q_steps": 200}}

    def road_ratio(name: str) -> float:
        run = offline.Offline(tiny(name, **changes))
        weights = run.weigh(run.context()).weights
        return weight_shares(run.data, weights)["weights/road_ratio"]

    assert road_ratio("ratio") > 5
    assert road_ratio("labels-swapped") < 3


def test_vagram_weighs_again_as_the_value_function_changes():
    events = list(offline.Offline(tiny("vagram", random_transitions=300)).events())
    first, second, third = (e for e in events if isinstance(e, Weights))
    assert first.per_dim is None  # no value function yet
    assert second.per_dim is not None
    assert third.per_dim is not None
    assert second.per_dim.shape == third.per_dim.shape == (len(first.weight), 2)
    assert not np.array_equal(second.per_dim, third.per_dim)


def test_uniform_starts_lie_where_the_data_lies_and_weighted_ones_on_the_road():
    def share_on_road(weighted: bool) -> float:
        run = offline.Offline(tiny("expert-only", rollout={"weighted_starts": weighted}))
        list(run.fit(value_gradient=False))
        run.roll_out_model()
        starts = run.model_buffer.transitions().obs[:100]
        return float(task.on_road(starts).float().mean())

    assert share_on_road(True) == 1.0
    assert share_on_road(False) < 0.6


def test_modelled_states_stay_on_the_map_and_earn_the_tasks_reward():
    run = offline.Offline(tiny("mle"))
    list(run.fit(value_gradient=False))
    run.roll_out_model()
    rows = run.model_buffer.transitions()
    assert rows.next_obs.min() >= 0
    assert rows.next_obs.max() <= 1
    torch.testing.assert_close(rows.reward, task.reward(rows.next_obs))
    assert torch.equal(rows.terminated.bool(), task.at_goal(rows.next_obs))


def _until_optimised(config: object) -> list[Event]:
    assert isinstance(config, RoadConfig)
    found: list[Event] = []
    for event in offline.Offline(config).events():
        if event.env_step > 0:
            break
        found.append(event)
    return found
