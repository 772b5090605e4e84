"""A trained policy in a file: the actor's parameters as plain arrays (`policy.npz`).

The file holds `env` (the task's name) and, from the first layer on, `weight_k` (in, out) and
`bias_k` (out,). The actor is an MLP with ReLU between its layers whose last layer gives mean and
log standard deviation of a Gaussian that tanh squashes: see `tom.sac`.
"""

import zipfile
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import relu

from tom.errors import UserError
from tom.nn import StackedMLP
from tom.sac import GaussianPolicy

NAME = "policy.npz"

Arrays = Mapping[str, NDArray]


def policy_arrays(env: str, actor: StackedMLP, member: int = 0) -> dict[str, NDArray]:
    """What the file of one member of `actor` holds."""
    arrays: dict[str, NDArray] = {"env": np.array(env)}
    for k, (weight, bias) in enumerate(zip(actor.weights, actor.biases, strict=True)):
        arrays[f"weight_{k}"] = weight[member].detach().numpy().copy()
        arrays[f"bias_{k}"] = bias[member, 0].detach().numpy().copy()
    return arrays


class StoredPolicy(GaussianPolicy):
    """The policy in a file, with the name of the task it was trained for."""

    def __init__(self, arrays: Arrays) -> None:
        """Raises ValueError or KeyError when the arrays are no policy's."""
        self.env = str(arrays["env"])
        layers = sum(name.startswith("weight_") for name in arrays)
        weights = [_parameter(arrays[f"weight_{k}"], 2) for k in range(layers)]
        biases = [_parameter(arrays[f"bias_{k}"], 1) for k in range(layers)]
        if not weights:
            raise ValueError("it holds no layers")
        sizes = [len(weights[0]), *(len(bias) for bias in biases)]
        if [tuple(w.shape) for w in weights] != list(pairwise(sizes)):
            raise ValueError("its layers do not fit together")
        if sizes[-1] % 2:
            raise ValueError("its last layer is not a mean and a deviation of each action")
        self.obs_dim, self.action_dim = sizes[0], sizes[-1] // 2
        actor = StackedMLP(1, sizes, relu, [torch.Generator()]).requires_grad_(False)
        for own, stored in zip((*actor.weights, *actor.biases), (*weights, *biases), strict=True):
            own.copy_(stored.view_as(own))
        super().__init__(actor, 0)


class UniformPolicy:
    """Actions uniform in [-1, 1], whatever is observed."""

    def __init__(self, obs_dim: int, action_dim: int) -> None:
        self.obs_dim, self.action_dim = obs_dim, action_dim

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n actions for obs (B, O): (n, B, A)."""
        return torch.rand(n, len(obs), self.action_dim, generator=generator) * 2 - 1


def read_policy(path: Path) -> StoredPolicy:
    """The policy in the file `path`. Raises UserError when there is none or it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return StoredPolicy({name: file[name] for name in file.files})
    except FileNotFoundError:
        raise UserError(
            f"no policy at {path}: name a run folder, its policy.npz or 'random'"
        ) from None
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path} is no stored policy ({reason[:120]}): name another") from error


def _parameter(array: NDArray, axes: int) -> Tensor:
    if array.dtype != np.float32 or array.ndim != axes or not np.isfinite(array).all():
        raise ValueError(f"a layer is not finite float32 numbers on {axes} axes")
    return torch.from_numpy(array)
