"""The parts of a Hopper step in the `paper` preset, and what other libraries do in their place."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical, MixtureSameFamily, Normal

from tom.bench.timing import (
    ACTION,
    BATCH,
    DISTANCES,
    EXAM,
    OBS,
    Part,
    model_flops,
    network_flops,
    rollout_flops,
    sac_flops,
)
from tom.bench.training import CYCLES, record_run
from tom.config import ModelConfig, PolicyDistanceConfig, RolloutConfig, SacConfig, TomConfig
from tom.data.replay import ReplayBuffer
from tom.data.sampling import WeightedSampler
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.envs import task
from tom.exams.exam import Exam, Fitted, critic_metrics, footprint_metrics, model_metrics
from tom.learners.base import FitContext
from tom.learners.policy_distance import PolicyDistanceLearner
from tom.learners.tom import TomLearner
from tom.policy.rollout import roll_out
from tom.policy.sac import Sac
from tom.record import Store

ROLLED = 20_000
"""start states of a rollout; the cost is printed per thousand"""
WEIGHED = 100_000
"""rows that are weighed: so many that the one training step of each network is negligible"""
EXAMINED = 250
"""rows of a fit's exam; its buffer has `WEIGHED` rows"""


def parts() -> Iterator[Part]:
    """Every part, a plain torch network, and stable-baselines3's update if it is installed."""
    yield _sac()
    yield _model_step("mdn")
    yield _model_step("ensemble")
    yield from _tom_steps()
    yield _distances()
    yield _rollout()
    yield _exam()
    yield _sampling()
    yield _environment()
    yield _recording()
    yield _plain_mdn()
    if find_spec("stable_baselines3"):
        yield _stable_baselines3()


def transitions(n: int, seed: int = 0) -> TensorTransitions:
    """n random Hopper-sized transitions."""
    g = torch.Generator().manual_seed(seed)
    obs = torch.randn(n, OBS, generator=g)
    action = torch.rand(n, ACTION, generator=g) * 2 - 1
    next_obs = obs + 0.1 * torch.randn(n, OBS, generator=g)
    return TensorTransitions(obs, action, obs[:, 0], next_obs, torch.zeros(n), torch.zeros(n))


def _sac() -> Part:
    config = SacConfig()
    sac = Sac(OBS, ACTION, config, torch.Generator().manual_seed(0))
    batches = transitions(BATCH).packed().expand(5, -1, -1)
    return Part(
        "SAC update", lambda: [sac.updates(batches) for _ in range(4)], 20, sac_flops(config)
    )


def _model_step(kind: str) -> Part:
    config = ModelConfig.model_validate({"kind": kind, "rounds": 1, "batches_per_round": 20})
    model = make_model(OBS, ACTION, config, torch.Generator().manual_seed(0))
    data = transitions(1000)
    weights, generator = torch.ones(len(data)), torch.Generator().manual_seed(1)
    return Part(
        f"{kind} step (in a fit)",
        lambda: model.fit(data, weights, None, generator),
        20,
        model_flops(config),
    )


def _tom_steps() -> Iterator[Part]:
    data = transitions(WEIGHED)
    policy = Sac(OBS, ACTION, SacConfig(), torch.Generator().manual_seed(0)).policy

    def weigh(steps: dict[str, int], rows: int) -> object:
        config = TomConfig.preset("paper").but(warmup=1, **steps)
        learner = TomLearner(config, OBS, ACTION, torch.Generator().manual_seed(0))
        return learner.weigh(
            FitContext(
                replay=data[:rows],
                policy_version=torch.zeros(rows, dtype=torch.int64),
                policy_buffer=data[-1000:],
                on_policy_steps=1000,
                initial_obs=data.obs[:100],
                policy=policy,
                generator=torch.Generator().manual_seed(1),
            )
        )

    none = {"discriminator_steps": 1, "q_steps": 1}
    config = TomConfig()
    judge = [2 * OBS + ACTION, config.discriminator_hidden, config.discriminator_hidden, 1]
    q = [OBS + ACTION, config.q_hidden, config.q_hidden, 1]
    judging, valuing = network_flops(judge, 2 * BATCH), network_flops(q, 3 * BATCH)
    acting = network_flops([OBS, 256, 256, 2 * ACTION], 1000)
    each = network_flops(judge, 1000) + 2 * network_flops(q, 1000) + acting
    yield Part(
        "discriminator step",
        lambda: weigh({**none, "discriminator_steps": 40}, 256),
        40,
        3 * judging - network_flops(judge[:2], 2 * BATCH),
    )
    yield Part(
        "dual Q step",
        lambda: weigh({**none, "q_steps": 40}, 256),
        40,
        3 * valuing - network_flops(q[:2], 3 * BATCH) + acting * 2 * BATCH / 1000,
    )
    yield Part("weights, 1000 transitions", lambda: weigh(none, WEIGHED), WEIGHED // 1000, each)


def _distances() -> Part:
    data, explored = transitions(40_000), 5000
    policy = Sac(OBS, ACTION, SacConfig(), torch.Generator().manual_seed(0)).policy
    context = FitContext(
        replay=data,
        policy_version=(torch.arange(len(data)) - explored).clamp(min=0),
        policy_buffer=data[-1000:],
        on_policy_steps=len(data) - explored,
        initial_obs=data.obs[:100],
        policy=policy,
        generator=torch.Generator(),
        behaviour=torch.zeros(len(data), 2 * ACTION),
    )
    learner = PolicyDistanceLearner(PolicyDistanceConfig())
    each = network_flops([OBS, 256, 256, 2 * ACTION], len(data) - explored)
    return Part(DISTANCES, lambda: learner.weigh(context), flops=each)


def _rollout() -> Part:
    model = make_model(OBS, ACTION, ModelConfig(), torch.Generator().manual_seed(0))
    policy = Sac(OBS, ACTION, SacConfig(), torch.Generator().manual_seed(0)).policy
    buffer = ReplayBuffer(ROLLED, OBS, ACTION)
    starts, generator = transitions(ROLLED).obs, torch.Generator().manual_seed(1)
    hopper, config = task("hopper"), RolloutConfig()
    return Part(
        "rollout, 1000 states",
        lambda: roll_out(model, policy, hopper.terminated, starts, 1, config, buffer, generator),
        ROLLED // 1000,
        rollout_flops(ModelConfig(), SacConfig()) * 1000,
    )


def _exam() -> Part:
    model = make_model(OBS, ACTION, ModelConfig(), torch.Generator().manual_seed(0))
    critic = Sac(OBS, ACTION, SacConfig(), torch.Generator().manual_seed(0)).policy
    generator, hopper, replay = torch.Generator(), task("hopper"), transitions(WEIGHED)
    replay.terminated[99::100] = 1.0
    fitted = Fitted(0, torch.rand(WEIGHED - EXAMINED, generator=generator))

    def sit() -> None:
        exam = Exam.of(fitted, replay, EXAMINED)
        footprint_metrics(exam, generator)
        model_metrics(model, exam, hopper.terminated, generator)
        critic_metrics(critic, exam.rows, 0.2, 0.99, generator)

    return Part(EXAM, sit)


def _sampling() -> Part:
    weights, generator = torch.rand(1_000_000), torch.Generator().manual_seed(0)
    return Part(
        "100k draws by weight from 1e6", lambda: WeightedSampler(weights, generator).draw(100_000)
    )


def _environment() -> Part:
    env = task("hopper").make()
    env.reset(seed=0)
    action = np.zeros(ACTION, np.float32)

    def step() -> None:
        for _ in range(200):
            if env.step(action)[2]:
                env.reset()

    return Part("Hopper-v5 step", step, 200)


def _recording() -> Part:
    folder = TemporaryDirectory()  # as long as the part is there

    def record() -> None:
        record_run(Store(Path(folder.name)))

    return Part("recording 250 steps, late in a run", record, CYCLES)


# Peers


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
