"""Rollouts in a learnt model against the plainest way of making them."""

import torch
from common import generator
from torch import Tensor

from tom.config import ModelConfig, RolloutConfig, SacConfig
from tom.data.replay import ReplayBuffer
from tom.dynamics.networks import Mdn
from tom.envs import task
from tom.policy.rollout import EXPLODED, roll_out
from tom.policy.sac import ActorCritic, Sac

HOPPER = task("hopper")
DIMS = HOPPER.obs_dim, HOPPER.action_dim


def parts() -> tuple[ActorCritic, Mdn]:
    """A policy, and a model whose steps sometimes end a rollout."""
    model = Mdn(*DIMS, ModelConfig(hidden=16, layers=2, components=3), generator(1))
    model.net.layers[-1][0].detach().mul_(3)
    return Sac(*DIMS, SacConfig(hidden=16), generator(2)).policy, model


def starts(n: int) -> Tensor:
    obs = 0.05 * torch.randn(n, DIMS[0], generator=generator(3))
    obs[:, 0] += 1.2
    obs[::17, 4] = float("inf")  # predicted as no number
    obs[1::29, 5] = 99.0
    return obs


def plainly(obs: Tensor, length: int, chunk: int) -> tuple[Tensor, dict[str, float]]:
    """Every row of every step, and the metrics, row by row."""
    policy, model = parts()
    g, rows = generator(4), []
    count = {"reward": 0.0, "terminated": 0, "diverged": 0, "exploded": 0}
    far = float(EXPLODED * obs.abs().max())
    for part in obs.split(chunk):
        for _ in range(length):
            action = policy(part, 1, g)[0]
            reward, after = model.sample(part, action, g)
            going = []
            for i, own in enumerate(after):
                if not (own.isfinite().all() and reward[i].isfinite()):
                    count["diverged"] += 1
                    continue
                end = bool(HOPPER.terminated(own[None])[0])
                count["reward"] += float(reward[i])
                count["terminated"] += end
                count["exploded"] += float(own.abs().max()) > far
                flags = torch.tensor([float(end), 0.0])
                rows.append(torch.cat([part[i], action[i], reward[i : i + 1], own, flags]))
                going += [] if end else [own]
            if not going:
                break
            part = torch.stack(going)
    steps = len(rows)
    found = {f"rollout/{name}": value / steps for name, value in count.items()}
    found["rollout/diverged"] = count["diverged"] / (steps + count["diverged"])
    return torch.stack(rows), found


def test_rollouts_are_those_of_one_row_after_another():
    policy, model = parts()
    buffer, config = ReplayBuffer(5000, *DIMS), RolloutConfig(chunk=64)
    g = generator(4)
    found = roll_out(model, policy, HOPPER.terminated, starts(200), 3, config, buffer, g)
    rows, wanted = plainly(starts(200), 3, 64)
    torch.testing.assert_close(buffer.transitions().packed(), rows)
    assert 0 < found["rollout/terminated"] < 1
    assert 0 < found["rollout/diverged"] < 1
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-6)


class Still:
    """A model in which nothing moves, and whose reward in the first row is no number."""

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        reward = torch.zeros(len(obs))
        reward[0] = float("inf")
        return reward, obs


def test_a_reward_that_is_no_number_ends_a_rollout():
    policy, _ = parts()
    buffer, obs = ReplayBuffer(100, *DIMS), torch.zeros(4, DIMS[0])
    obs[:, 0] = 1.2
    found = roll_out(
        Still(), policy, HOPPER.terminated, obs, 1, RolloutConfig(), buffer, generator(4)
    )
    assert len(buffer) == 3
    assert buffer.transitions().reward.isfinite().all()
    assert found["rollout/diverged"] == 0.25
