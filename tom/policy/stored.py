"""A trained policy in a file: its networks' parameters as plain arrays (`policy.npz`).

The file holds `env` (the task's name) and, from the first layer on, `weight_k` (in, out) and
`bias_k` (out,) of the actor: an MLP with ReLU between its layers whose last layer gives mean and
log standard deviation of a Gaussian that tanh squashes (see `tom.policy.sac`).
`critic_weight_k` and `critic_bias_k`, with a leading axis of 2, are those of the twin critics
Q(s, a); files of earlier versions have none. Numbers are float32, in small copies of runs float16.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import log
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import relu

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.data.unpack import DAMAGE, read_arrays
from tom.errors import UserError, reason
from tom.nn.mlp import StackedMLP
from tom.policy.sac import Actor, ActorCritic, Sac

NAME = "policy.npz"
CRITIC = "critic_"

Arrays = Mapping[str, NDArray]
Layers = Sequence[tuple[Tensor | NDArray, Tensor | NDArray]]


def policy_arrays(env: str, sac: Sac) -> dict[str, NDArray]:
    """The arrays of the file for the first member of `sac`."""
    actor = [(weight[0], bias[0, 0]) for weight, bias in sac.actor.layers]
    critics = [(weight, bias[:, 0]) for weight, bias in sac.critic.layers]
    return layer_arrays(env, actor, critics)


def layer_arrays(env: str, actor: Layers, critics: Layers = ()) -> dict[str, NDArray]:
    """The arrays of the file for weight and bias of each layer."""
    arrays: dict[str, NDArray] = {"env": np.array(env)}
    for prefix, layers in (("", actor), (CRITIC, critics)):
        for k, (weight, bias) in enumerate(layers):
            for name, part in (("weight", weight), ("bias", bias)):
                part = part.detach().cpu() if isinstance(part, Tensor) else part
                arrays[f"{prefix}{name}_{k}"] = np.array(part, np.float32)
    return arrays


class StoredPolicy(Actor):
    """The policy in a file, with the name of the task it was trained for.

    `value_gradient` is that of its critics, None if the file has no critics.
    """

    def __init__(self, arrays: Arrays) -> None:
        """Raises ValueError or KeyError if the arrays are not those of a policy."""
        self.env = str(arrays["env"])
        self.actor, sizes = _network({n: array[None] for n, array in _layers(arrays).items()})
        if sizes[-1] % 2:
            raise ValueError("its last layer is not a mean and a deviation of each action")
        self.obs_dim, self.action_dim = sizes[0], sizes[-1] // 2
        super().__init__(self.actor)
        self.critic: StackedMLP | None = None
        self.value_gradient: Callable[[Tensor], Tensor] | None = None
        if layers := _layers(arrays, CRITIC):
            self.critic, sizes = _network(layers)
            if (sizes[0], sizes[-1]) != (self.obs_dim + self.action_dim, 1):
                raise ValueError("its critics do not fit its actor")
            self.value_gradient = ActorCritic(self.actor, self.critic).value_gradient


def resumed_sac(
    policy: StoredPolicy, config: SacConfig, temperature: float, generator: torch.Generator
) -> Sac:
    """SAC that goes on with the file's actor and critics.

    Its target critics equal its critics and its optimisers are new: the file holds neither. Raises
    RuntimeError if `config` has other layers.
    """
    assert policy.critic is not None, "files of earlier versions have none"
    sac = Sac(policy.obs_dim, policy.action_dim, config, generator)
    sac.actor.load_state_dict(policy.actor.state_dict())
    for net in (sac.critic, sac.target_critic):
        net.load_state_dict(policy.critic.state_dict())
    sac.log_temperature.fill_(log(temperature))
    return sac


class UniformPolicy:
    """Actions uniform in [-1, 1], independent of the observation."""

    value_gradient = None  # it has no value function

    def __init__(self, obs_dim: int, action_dim: int) -> None:
        self.obs_dim, self.action_dim = obs_dim, action_dim

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n actions for obs (B, O): (n, B, A)."""
        return torch.rand(n, len(obs), self.action_dim, generator=generator) * 2 - 1

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions for obs (B, O): (B, A)."""
        return torch.zeros(len(obs), self.action_dim)


def distances(mean: Callable[[Tensor], Tensor], rows: TensorTransitions) -> NDArray[np.float32]:
    """The distance (N,) from each row's action to `mean`'s, a policy's mean action there.

    Root mean square over the action's dimensions; actions are in [-1, 1].
    """
    return (mean(rows.obs) - rows.action).square().mean(-1).sqrt().numpy()


def read_policy(path: Path) -> StoredPolicy:
    """The policy in the file `path`. Raises UserError if it is missing or damaged."""
    try:
        return StoredPolicy(read_arrays(path))
    except FileNotFoundError:
        raise UserError(
            f"no policy at {path}: name a run, its policy.npz, a TorchScript (.pt) or ONNX file, a "
            "function module:name, or 'random'"
        ) from None
    except (*DAMAGE, AttributeError) as error:
        if path.suffix != ".npz":
            raise UserError(
                f"{path} is not a readable policy: export it as TorchScript (.pt) or ONNX "
                "(docs/your-own.md, for stable-baselines3 too)"
            ) from None
        raise UserError(f"{path} is not a stored policy ({reason(error)}): name another") from error


def _layers(arrays: Arrays, prefix: str = "") -> dict[str, NDArray]:
    parts = prefix + "weight_", prefix + "bias_"
    return {n.removeprefix(prefix): array for n, array in arrays.items() if n.startswith(parts)}


def _network(layers: Arrays) -> tuple[StackedMLP, list[int]]:
    """The networks of `weight_k` (M, in, out) and `bias_k` (M, out), and their sizes."""
    count = sum(name.startswith("weight_") for name in layers)
    if not count:
        raise ValueError("the file holds no layers")
    weights = [_parameter(layers[f"weight_{k}"], 3) for k in range(count)]
    biases = [_parameter(layers[f"bias_{k}"], 2) for k in range(count)]
    members, sizes = len(weights[0]), [weights[0].shape[1], *(bias.shape[1] for bias in biases)]
    if [tuple(w.shape) for w in weights] != [(members, *pair) for pair in pairwise(sizes)]:
        raise ValueError("its layers do not fit together")
    net = StackedMLP(members, sizes, relu, torch.Generator()).requires_grad_(False)
    for own, stored in zip(net.tensors(), (*weights, *biases), strict=True):
        own.copy_(stored.view_as(own))
    return net, sizes


def _parameter(array: NDArray, axes: int) -> Tensor:
    floats = array.dtype in (np.float32, np.float16)
    if not floats or array.ndim != axes or not np.isfinite(array).all():
        raise ValueError(f"a layer is not finite float32 or float16 numbers on {axes - 1} axes")
    return torch.from_numpy(array.astype(np.float32))
