"""The same work done by other libraries, for comparison, if they are installed."""

from collections.abc import Iterator
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, MixtureSameFamily, Normal

from tom.bench.parts import ACTION, BATCH, OBS, transitions
from tom.bench.timing import Part
from tom.config import SacConfig
from tom.nn.mlp import StackedMLP
from tom.policy.sac import Sac, squashed_gaussian


def peers() -> Iterator[Part]:
    """Plain torch implementations, and every peer that is installed."""
    yield _plain_mdn()
    yield _autograd_sac()
    if find_spec("stable_baselines3"):
        yield _stable_baselines3()
    if find_spec("mbrl"):
        yield _mbrl()


INSTALL = {
    "stable_baselines3": "pip install 'stable-baselines3>=2.9'",
    # It requires gymnasium 0.26.3, which would replace ours.
    "mbrl": "pip install --no-deps mbrl && pip install omegaconf hydra-core PyYAML termcolor",
}


def missing() -> list[str]:
    """The peers that are not installed, with the command for each."""
    return [f"{name}: {how}" for name, how in INSTALL.items() if not find_spec(name)]


def _plain_mdn() -> Part:
    """A mixture density network in plain torch: linear layers, MixtureSameFamily, Adam."""
    layers: list[nn.Module] = []
    for n_in in (OBS + ACTION, 200, 200, 200):
        layers += [nn.Linear(n_in, 200), nn.SiLU()]
    outputs = 1 + OBS
    net = nn.Sequential(*layers, nn.Linear(200, 3 * 10 * outputs))
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3)
    x, y = torch.randn(BATCH, OBS + ACTION), torch.randn(BATCH, outputs)

    def step() -> None:
        mean, raw, logits = net(x).reshape(BATCH, 3, outputs, 10).unbind(1)
        mixture = MixtureSameFamily(
            Categorical(logits=logits), Normal(mean, nn.functional.softplus(raw) + 1e-3)
        )
        optimiser.zero_grad()
        (-mixture.log_prob(y)).mean().backward()
        optimiser.step()

    return Part(
        "plain torch.distributions MDN step",
        lambda: [step() for _ in range(20)],
        20,
        peer_of="mdn step (in a fit)",
    )


def _autograd_sac() -> Part:
    """Our own networks and three losses, with gradients by autograd and torch's fused Adam."""
    sac = Sac(OBS, ACTION, SacConfig(), torch.Generator().manual_seed(0))
    actor, critic = sac.actor.requires_grad_(True), sac.critic.requires_grad_(True)
    temperature = sac.log_temperature.clone().requires_grad_(True)
    optimisers = [
        torch.optim.Adam(tensors, lr=3e-4, fused=True)
        for tensors in (critic.tensors(), actor.tensors(), [temperature])
    ]
    batch = transitions(BATCH)[None]

    def descend(optimiser: torch.optim.Adam, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    def drawn(obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = actor(obs).chunk(2, -1)
        noise = torch.randn_like(mean)
        action, log_prob = squashed_gaussian(mean, raw.clamp(-20, 2), noise)
        return action, log_prob.squeeze(-1)

    def values(net: StackedMLP, obs: Tensor, action: Tensor) -> Tensor:
        return net(torch.cat([obs, action], -1).expand(2, -1, -1))[..., 0]

    def step() -> None:
        with torch.no_grad():
            target = sac.critic_target(batch, torch.randn(1, BATCH, ACTION))
        critic_loss = (values(critic, batch.obs, batch.action) - target).square().mean(1).sum()
        descend(optimisers[0], critic_loss)
        action, log_prob = drawn(batch.obs)
        critic.requires_grad_(False)
        q = values(critic, batch.obs, action).amin(0)
        descend(optimisers[1], (temperature.detach().exp() * log_prob - q).mean())
        critic.requires_grad_(True)
        gap = (log_prob.detach() - ACTION).mean()
        descend(optimisers[2], -(temperature * gap).sum())
        with torch.no_grad():
            pairs = zip(sac.target_critic.tensors(), critic.tensors(), strict=True)
            for averaged, now in pairs:
                averaged.lerp_(now, sac.config.tau)

    return Part(
        "SAC update, autograd and fused Adam",
        lambda: [step() for _ in range(20)],
        20,
        peer_of="SAC update",
    )


def _stable_baselines3() -> Part:
    import gymnasium as gym
    from stable_baselines3 import SAC  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.logger import configure  # pyright: ignore[reportMissingImports]

    agent = SAC("MlpPolicy", gym.make("Hopper-v5"), batch_size=BATCH, device="cpu", verbose=0)
    agent.set_logger(configure(None, []))
    rows = transitions(1000).numpy()
    buffer = agent.replay_buffer
    assert buffer is not None
    fields = rows.obs, rows.next_obs, rows.action, rows.reward, rows.terminated
    columns = map(np.asarray, fields)
    for obs, following, action, reward, end in zip(*columns, strict=True):
        buffer.add(obs, following, action, reward, end, [{}])
    return Part(
        "stable-baselines3 SAC update",
        lambda: agent.train(gradient_steps=20, batch_size=BATCH),
        20,
        peer_of="SAC update",
    )


def _mbrl() -> Part:
    import gymnasium as gym
    from mbrl.third_party.pytorch_sac_pranz24.sac import SAC  # pyright: ignore[reportMissingImports]

    space = gym.spaces.Box(-1.0, 1.0, (ACTION,))
    arguments = SimpleNamespace(
        gamma=0.99, tau=0.005, alpha=0.2, policy="Gaussian", target_update_interval=1,
        automatic_entropy_tuning=True, target_entropy=-3.0, device="cpu", hidden_size=256,
        lr=3e-4, batch_size=BATCH,
    )  # fmt: skip
    agent = SAC(OBS, space, arguments)
    rows = transitions(BATCH).numpy()
    batch = (rows.obs, rows.action, rows.next_obs, rows.reward, rows.terminated, rows.truncated)

    class Memory:
        def sample(self, size: int) -> SimpleNamespace:
            return SimpleNamespace(astuple=lambda: batch)

    memory = Memory()
    return Part(
        "mbrl-lib SAC update",
        lambda: [agent.update_parameters(memory, BATCH, i) for i in range(20)],
        20,
        peer_of="SAC update",
    )
