from dataclasses import replace

import pytest
import torch

from tom.data.transitions import TensorTransitions
from tom.exams.diagnostics import (
    ending_metrics,
    step_scale,
    weight_metrics,
)
from tom.exams.energy import step_scaling


def line(n: int, ended: list[int] | None = None) -> TensorTransitions:
    """A point that moves by its action, 1 + its number, along a line; some rows end episodes."""
    action = torch.arange(1.0, n + 1).unsqueeze(1)
    next_obs = action.cumsum(0)
    terminated = torch.zeros(n)
    terminated[ended or []] = 1.0
    return TensorTransitions(
        next_obs - action, action, torch.zeros(n), next_obs, terminated, torch.zeros(n)
    )


def test_a_dimension_that_never_changes_is_in_its_own_units_as_in_the_model():
    """A goal that stays where it is for an episode (Reacher) has no change to compare with."""
    rows = line(20)
    still = torch.full((20, 1), 3.0)
    obs, next_obs = (torch.cat((x, still), 1) for x in (rows.obs, rows.next_obs))
    both = replace(rows, obs=obs, next_obs=next_obs)
    scale = step_scale(both)
    assert scale.tolist() == pytest.approx([float(rows.action.std(correction=0)), 1.0])
    assert torch.equal(scale, step_scaling(both).std[-2:]), "as in an exam"


def test_weight_metrics_by_hand():
    metrics = weight_metrics(torch.tensor([0.0, 0.0, 1.0, 3.0]))
    assert metrics["weights/zeros"] == 0.5
    assert metrics["weights/max"] == 3
    assert metrics["weights/ess"] == pytest.approx(16 / 10 / 4)
    assert metrics["weights/age_correlation"] > 0.9
    assert weight_metrics(torch.ones(5))["weights/age_correlation"] == 0


def test_what_ends_an_episode_counts_by_hand():
    rows = line(4, [1, 3])
    found = ending_metrics(rows, rows[2:], torch.tensor([0.0, 1.0, 2.0, 1.0]))
    assert found == {"weights/ends": 0.5, "weights/ends_policy": 0.5}
    assert ending_metrics(rows, rows[2:], torch.zeros(4)) == {}
    assert ending_metrics(line(4), line(2), torch.ones(4)) == {}
