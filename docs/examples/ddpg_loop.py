"""DDPG with prioritised replay in a single file, recorded: lines with `run` are all that it takes.

python ddpg_loop.py [STEPS]
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import tom

ENV, SEED, BATCH, GAMMA, TAU, START = "Pendulum-v1", 0, 128, 0.98, 0.005, 500


def network(inputs: int, outputs: int) -> nn.Sequential:
    hidden = (nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
    return nn.Sequential(*hidden, nn.Linear(64, outputs))


def main(steps: int = 6000) -> None:
    torch.manual_seed(SEED)
    rng = np.random.default_rng(SEED)
    env = gym.make(ENV)
    env.action_space.seed(SEED)
    assert isinstance(env.action_space, gym.spaces.Box)
    low, high = env.action_space.low, env.action_space.high
    obs_dim, action_dim = len(env.reset(seed=SEED)[0]), len(low)
    actor, critic = network(obs_dim, action_dim), network(obs_dim + action_dim, 1)
    targets = network(obs_dim, action_dim), network(obs_dim + action_dim, 1)
    for target, own in zip(targets, (actor, critic), strict=True):
        target.load_state_dict(own.state_dict())
    optimisers = [torch.optim.Adam(net.parameters(), 1e-3) for net in (actor, critic)]
    scale = torch.as_tensor(high)

    def act(obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return (scale * torch.tanh(actor(torch.as_tensor(obs)))).numpy()

    obs_of, next_of = np.zeros((2, steps, obs_dim), np.float32)
    action_of = np.zeros((steps, action_dim), np.float32)
    reward_of, end_of, priority = np.zeros((3, steps), np.float32)
    with tom.record("my-ddpg", env=ENV, config={"tau": TAU}, steps=steps, seed=SEED) as run:
        tom.weigh_live(run, every=1000)
        obs, _ = env.reset(seed=SEED)
        for step in range(steps):
            noisy = act(obs) + rng.normal(0, 0.2, action_dim) * high
            action = env.action_space.sample() if step < START else np.clip(noisy, low, high)
            next_obs, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
            run.transitions(obs, action, reward, next_obs, terminated, truncated)
            obs_of[step], action_of[step], reward_of[step] = obs, action, reward
            next_of[step], end_of[step] = next_obs, terminated
            priority[step] = priority.max() or 1.0
            obs = env.reset()[0] if terminated or truncated else next_obs
            if step < START:
                continue

            share = priority[: step + 1] / priority[: step + 1].sum()
            rows = rng.choice(step + 1, BATCH, p=share)
            s, a, r, s2, end = (
                torch.as_tensor(x[rows]) for x in (obs_of, action_of, reward_of, next_of, end_of)
            )
            with torch.no_grad():
                ahead = targets[1](torch.cat((s2, scale * torch.tanh(targets[0](s2))), 1))[:, 0]
            error = critic(torch.cat((s, a), 1))[:, 0] - (r + GAMMA * (1 - end) * ahead)
            optimisers[1].zero_grad()
            error.square().mean().backward()
            optimisers[1].step()
            value = critic(torch.cat((s, scale * torch.tanh(actor(s))), 1)).mean()
            optimisers[0].zero_grad()
            (-value).backward()
            optimisers[0].step()
            priority[rows] = error.detach().abs().numpy() ** 0.6 + 1e-3
            for target, own in zip(targets, (actor, critic), strict=True):
                for kept, new in zip(target.parameters(), own.parameters(), strict=True):
                    kept.data.lerp_(new.data, TAU)

            if (step + 1) % 1000 == 0 or step + 1 == steps:
                run.metrics(step + 1, {"critic/loss": error.square().mean(), "critic/q": value})
                run.policy(step + 1, act)
                run.weights(step + 1, priority[: step + 1])
                run.evaluate(step + 1)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
