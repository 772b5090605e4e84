"""A policy of the user's as the arrays that runs keep (`tom.policy.stored`).

SAC, TD3 and DDPG of stable-baselines3 with ReLU networks are taken over as they are, SAC and TD3
with their critics. Any other policy is asked on recorded observations, and a network of the stored
form learns its answers.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import relu

from tom.envs import Task
from tom.errors import UserError
from tom.nn.mlp import StackedMLP
from tom.policy.foreign import ForeignPolicy
from tom.policy.stored import layer_arrays

HIDDEN, LR, BATCH = 64, 3e-3, 256
STEPS, STEPS_AGAIN = 600, 150
"""of a copy's training: the first time, and when it goes on from the last copy"""
MAX_OBSERVATIONS, DRAWS = 2000, 8
"""observations that a policy is asked about, and actions for each"""
NARROW = -20.0
"""log standard deviation of a policy without spread"""

Layers = list[tuple[NDArray[np.float64], NDArray[np.float64]]]
"""weight (in, out) and bias (out,) of each layer, ReLU between them"""


Copy = tuple[dict[str, NDArray], float | None]
"""the stored arrays, and how far a learnt copy is from the policy's answers (None: exact)"""


class PolicyCopier:
    def __init__(self, known: Task) -> None:
        self._task = known
        self._offset, self._scale = known.obs_units
        self._net: StackedMLP | None = None

    def copy(self, policy: Any, obs: NDArray) -> Copy:
        """The policy, asked about obs (N, O) as agents see them where it has to be learnt.

        It is a model of stable-baselines3, a torch module or a function of observations (B, O) in
        the task's own units, which answers as `tom.policy.foreign` says. Raises UserError.
        """
        exact = _networks(policy)
        if exact is None:
            return self._fit_copy(policy, obs)
        actor, critics, centre, spread = exact
        dims = actor[0][0].shape[0], actor[-1][0].shape[1] // 2
        if dims != (self._task.obs_dim, self._task.action_dim):
            raise UserError(
                f"its network maps {dims[0]} numbers to {dims[1]} actions, and "
                f"{self._task.name} has {self._task.obs_dim} and {self._task.action_dim}"
            )
        scale, offset = self._scale / spread, (self._offset - centre) / spread
        pair = critics[:2] if len(critics) >= 2 else []
        twins = [_fold_scaling(critic, scale, offset) for critic in pair]
        joined = (zip(*of, strict=True) for of in zip(*twins, strict=True))
        both = [(np.stack(weights), np.stack(biases)) for weights, biases in joined]
        return layer_arrays(self._task.name, _fold_scaling(actor, scale, offset), both), None

    def _fit_copy(self, policy: Any, obs: NDArray) -> Copy:
        """A network that has learnt the policy's mean and spread before the tanh."""
        if not len(obs):
            raise UserError("hand in some transitions first, whose observations it is asked about")
        foreign = ForeignPolicy("of run.policy", _as_function(policy), self._task)
        seen = torch.from_numpy(obs[:: max(len(obs) // MAX_OBSERVATIONS, 1)]).float()
        generator = torch.Generator().manual_seed(0)

        def drawn_anew() -> Tensor:
            return torch.atanh(foreign(seen, DRAWS, generator).clamp(-0.999, 0.999))

        drawn = drawn_anew()
        mean, log_std = drawn.mean(0), drawn.std(0).clamp(min=1e-3).log()
        spread, centre = torch.std_mean(seen, 0, correction=0)
        spread = spread.clamp(min=1e-6)
        steps = STEPS if self._net is None else STEPS_AGAIN
        if self._net is None:
            sizes = [seen.shape[1], HIDDEN, HIDDEN, 2 * mean.shape[1]]
            self._net = StackedMLP(1, sizes, relu, generator)
        x, optimiser = (seen - centre) / spread, torch.optim.Adam(self._net.parameters(), LR)
        with torch.enable_grad():
            for _ in range(steps):
                rows = torch.randint(len(x), (BATCH,), generator=generator)
                own_mean, own_log_std = self._net(x[rows][None])[0].chunk(2, -1)
                near = (own_mean.tanh() - mean[rows].tanh()).square().mean()
                far = (own_mean - mean[rows]).square().mean()
                wide = (own_log_std - log_std[rows]).square().mean()
                optimiser.zero_grad()
                (near + 0.01 * far + 0.1 * wide).backward()
                optimiser.step()
        with torch.no_grad():
            own_mean = self._net(x[None])[0].chunk(2, -1)[0].tanh()
            # Twice, from other draws each time, whose noise is no error and falls out.
            off, again = (own_mean - drawn_anew().mean(0).tanh() for _ in range(2))
        layers = [(_numbers(w[0]), _numbers(b[0, 0])) for w, b in self._net.layers]
        scale, offset = 1 / _numbers(spread), -_numbers(centre / spread)
        arrays = layer_arrays(self._task.name, _fold_scaling(layers, scale, offset))
        return arrays, float((off * again).mean().clamp(min=0).sqrt())


def _fold_scaling(layers: Layers, scale: NDArray, offset: NDArray) -> Layers:
    """The layers for inputs x whose first dimensions are what was `offset + scale * x` before."""
    weight, bias = layers[0]
    first, n = weight.copy(), len(scale)
    first[:n] *= scale[:, None]
    return [(first, bias + offset @ weight[:n]), *layers[1:]]


def _as_function(policy: Any) -> Callable[[Tensor], Any]:
    if isinstance(policy, nn.Module):
        parameter = next(policy.parameters(), torch.zeros(0))
        return lambda obs: policy(obs.to(parameter))
    predict = getattr(policy, "predict", None)
    if not callable(policy) and predict is None:
        raise UserError("give a function of observations, a torch module or SB3's model")
    if predict is None:
        return lambda obs: policy(obs.numpy().astype(np.float32))
    normalised = getattr(policy, "get_vec_normalize_env", lambda: None)()
    seen = (lambda obs: obs) if normalised is None else normalised.normalize_obs

    def predicted(obs: Tensor) -> Any:
        actions = predict(seen(obs.numpy().astype(np.float32)), deterministic=False)[0]
        if not getattr(policy, "use_sde", False):
            return actions
        # gSDE: all these actions have one draw of the noise in common.
        parts = (getattr(policy, name, None) for name in ("actor", "policy"))
        drawn_by = next(part.action_dist for part in parts if part)
        of = drawn_by.distribution
        return (of.mean, of.stddev.log()) if drawn_by.bijector else of.sample()

    return predicted


def _networks(model: Any) -> tuple[Layers, list[Layers], Any, Any] | None:
    """An off-policy model's actor and critics; None if they have another form.

    Then the mean and spread, (O,) each, by which stable-baselines3 normalises its observations.
    """
    actor = getattr(model, "actor", None)
    if actor is None or not hasattr(model, "get_vec_normalize_env") or not hasattr(actor, "mu"):
        return None
    if type(actor.features_extractor).__name__ != "FlattenExtractor":  # a network before these
        return None
    if isinstance(actor.mu, nn.Linear):  # SAC
        layers = _layers([*getattr(actor, "latent_pi", ())])
        if layers is None or not isinstance(actor.log_std, nn.Linear):  # or it explores by a state
            return None
        (mean, mean_bias), (std, std_bias) = _layer(actor.mu), _layer(actor.log_std)
        layers.append((np.hstack((mean, std)), np.hstack((mean_bias, std_bias))))
    else:  # TD3, DDPG: the last module is the tanh
        layers = _layers([*actor.mu][:-1]) if isinstance([*actor.mu][-1], nn.Tanh) else None
        if layers is None:
            return None
        weight, bias = layers[-1]
        narrow = np.append(bias, np.full(len(bias), NARROW))
        layers[-1] = np.hstack((weight, np.zeros_like(weight))), narrow
    critics = [_layers([*net]) for net in getattr(model.critic, "q_networks", ())]
    # TQC's give many quantiles.
    whole = [critic for critic in critics if critic and critic[-1][0].shape[1] == 1]
    normalised = model.get_vec_normalize_env()
    if normalised is None or not normalised.norm_obs:
        return layers, whole, 0.0, 1.0
    moments = normalised.obs_rms
    return layers, whole, moments.mean, np.sqrt(moments.var + normalised.epsilon)


def _layers(modules: Sequence[nn.Module]) -> Layers | None:
    """The linear layers of a ReLU network; None if it has anything else."""
    linear = [module for module in modules if isinstance(module, nn.Linear)]
    if len(linear) + sum(isinstance(module, nn.ReLU) for module in modules) != len(modules):
        return None
    return [_layer(module) for module in linear]


def _layer(linear: nn.Linear) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return _numbers(linear.weight).T.copy(), _numbers(linear.bias)


def _numbers(tensor: Tensor) -> NDArray[np.float64]:
    return tensor.detach().cpu().double().numpy()
