"""The same work by well-known code, for comparison, where it is installed."""

from collections.abc import Iterator
from importlib.util import find_spec
from types import SimpleNamespace

import torch
from torch import nn
from torch.distributions import Categorical, MixtureSameFamily, Normal

from tom.bench.parts import ACTION, BATCH, OBS, transitions
from tom.bench.timing import Part


def peers() -> Iterator[Part]:
    """Plain `torch.distributions`, and whatever of the peers is installed."""
    yield _plain_mdn()
    if find_spec("stable_baselines3"):
        yield _stable_baselines3()
    if find_spec("mbrl"):
        yield _mbrl()


INSTALL = {
    "stable_baselines3": "pip install 'stable-baselines3>=2.9'",
    # Its own requirement of gymnasium 0.26.3 would take ours away.
    "mbrl": "pip install --no-deps mbrl && pip install omegaconf hydra-core PyYAML termcolor",
}


def missing() -> list[str]:
    """The peers that are not installed, with the command for each."""
    return [f"{name}: {how}" for name, how in INSTALL.items() if not find_spec(name)]


def _plain_mdn() -> Part:
    """A mixture density network as one would write it: linear layers, MixtureSameFamily, Adam."""
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


def _stable_baselines3() -> Part:
    import gymnasium as gym
    from stable_baselines3 import SAC  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.logger import configure  # pyright: ignore[reportMissingImports]

    agent = SAC("MlpPolicy", gym.make("Hopper-v5"), batch_size=BATCH, device="cpu", verbose=0)
    agent.set_logger(configure(None, []))
    rows = transitions(1000).numpy()
    for i in range(1000):
        agent.replay_buffer.add(
            rows.obs[i], rows.next_obs[i], rows.action[i], rows.reward[i], rows.terminated[i], [{}]
        )
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
