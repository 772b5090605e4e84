"""Policies that were not trained here.

A policy of another library is a TorchScript or ONNX file, or a function `module:name`. It maps
observations (B, O) either to `(mean, log_std)`, (B, A) each, of a Gaussian that tanh squashes into
[-1, 1] (soft actor-critic's policy), or to actions (B, A) in the task's own units. Functions and
TorchScript files are code that can do anything (docs/security.md).

Behaviour cloning estimates the policy behind recorded transitions.
"""

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import relu

from tom.data.card import PolicyFacts, Range
from tom.data.transitions import TensorTransitions
from tom.envs.task import Task
from tom.envs.user_code import error_location, import_function
from tom.errors import USER_CODE_ERRORS, UserError, reason
from tom.nn.mlp import StackedMLP

TORCHSCRIPT = (".pt", ".pth", ".ts", ".torchscript")
ONNX = ".onnx"
INTERPRETER = "TorchScript interpreter."
"""end of the first line of an error in a TorchScript network; this line has no information"""
_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_LARGEST_SEED = 2**62
_ONNX_TYPES = {"tensor(double)": np.float64, "tensor(float16)": np.float16}
HIDDEN = 64  # of a clone
STEPS = 200  # few, because more steps would fit the noise of a trajectory's few dozen rows
LR = 3e-3
WEIGHT_DECAY = 1e-3
MIN_STD = 1e-2


def is_foreign(name: str) -> bool:
    """Whether `name` is that of a TorchScript or ONNX file, or of a function."""
    return Path(name).suffix in (*TORCHSCRIPT, ONNX) or _is_function(name)


class ForeignPolicy:
    """A policy of another library as a `tom.learners.base.Policy`, without a value function.

    Its draws from torch's global generator are reproducible too: each call seeds that generator.
    """

    value_gradient = None

    def __init__(self, name: str, ask: Callable[[Tensor], Any], task: Task) -> None:
        """Tests it on two observations. Raises UserError if the output is not that of a policy.

        `ask` gets observations (B, O) in the task's own units, in double precision.
        """
        self.name, self.obs_dim, self.action_dim = name, task.obs_dim, task.action_dim
        self._ask, self._own_obs = ask, task.own_obs
        self._low, self._high = map(torch.as_tensor, task.action_bounds)
        self._drawn = False
        obs = torch.zeros(2, self.obs_dim)
        first, again = (self._answer(obs, torch.Generator().manual_seed(seed)) for seed in range(2))
        # A mean is the same at each call: what is drawn anew is an action.
        self._drawn = len(first) == 2 and not torch.equal(first[0], again[0])

    @torch.no_grad()
    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, O): (n, B, A) in [-1, 1]. Raises UserError."""
        answer = self._answer(obs.to(torch.float32).repeat(n, 1), generator)
        return self._action(answer, generator).clamp(-1, 1).unflatten(0, (n, len(obs)))

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions for obs (B, O): (B, A), or actions of a policy that only draws them."""
        answer = self._answer(obs.to(torch.float32), torch.Generator().manual_seed(0))
        gaussian = len(answer) == 2 and not self._drawn
        mean = torch.tanh(answer[0]) if gaussian else self._action(answer, torch.Generator())
        return mean.clamp(-1, 1)

    def gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before tanh for obs (B, O): (B, A). Raises UserError."""
        answer = self._answer(obs.to(torch.float32), torch.Generator().manual_seed(0))
        if len(answer) == 1 or self._drawn:
            raise UserError(
                f"policy {self.name} returns actions: its distance to other policies needs mean "
                "and log_std"
            )
        return answer[0], answer[1]

    def facts(self, obs: Tensor) -> PolicyFacts:
        """What it answers to observations (B, O), for the card. Raises UserError."""
        generator = torch.Generator().manual_seed(0)
        answer = self._answer(obs, generator)
        action = self._action(answer, generator)
        log_std = None if len(answer) == 1 else (float(answer[1].min()), float(answer[1].max()))
        return PolicyFacts(
            own=Range.of(answer[0].numpy()),
            spread=float(action.clamp(-1, 1).std(0, correction=0).mean()),
            log_std=log_std,
            drawn=self._drawn,
            beyond=float((action.abs() > 3).float().mean()),
        )

    def _action(self, answer: tuple[Tensor, ...], generator: torch.Generator) -> Tensor:
        """Actions (B, A), in [-1, 1] unless they lie outside the task's bounds."""
        if len(answer) == 2 and not self._drawn:
            mean, log_std = answer
            noise = torch.randn(mean.shape, generator=generator)
            return torch.tanh(mean + log_std.exp() * noise)
        return (2 * answer[0] - self._high - self._low) / (self._high - self._low)

    @torch.no_grad()
    def _answer(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
        """(mean, log_std) or (actions,), each (B, A)."""
        seed = int(torch.randint(_LARGEST_SEED, (1,), generator=generator))
        try:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed)
                own = torch.as_tensor(self._own_obs(obs.numpy()), dtype=torch.float64)
                output = self._ask(own)
            parts = output if isinstance(output, tuple) else (output,)
            if isinstance(output, list) and all(isinstance(part, Tensor) for part in output):
                parts = tuple(output)  # TorchScript gives lists
            if len(parts) == 2 and (parts[1] is None or np.size(parts[1]) == 0):
                parts = parts[:1]  # the second output of `predict`: the state of a policy without
            answer = tuple(_numbers(part) for part in parts)
        except UserError:
            raise
        except USER_CODE_ERRORS as error:
            raise UserError(
                f"policy {self.name} fails on observations {tuple(obs.shape)}, any number of which "
                f"it must take: {_error_reason(error)}{error_location(error)}"
            ) from error
        shape = len(obs), self.action_dim
        if self.action_dim == len(answer) == 1 and answer[0].shape == shape[:1]:
            answer = (answer[0][:, None],)
        if len(answer) not in (1, 2) or any(part.shape != shape for part in answer):
            shapes = ", ".join(str(tuple(part.shape)) for part in answer) or "nothing"
            raise UserError(
                f"policy {self.name} maps observations {tuple(obs.shape)} to {shapes}: it must "
                f"return actions {shape}, or mean and log_std {shape} each"
            )
        if not all(bool(part.isfinite().all()) for part in answer):
            raise UserError(f"policy {self.name} returns numbers that are not finite: name another")
        return answer


def _numbers(part: Any) -> Tensor:
    """A tensor, or anything that numpy takes for an array, in single precision."""
    array = part.detach() if isinstance(part, Tensor) else torch.from_numpy(np.array(part))
    return array.to("cpu", torch.float32)


def _error_reason(error: BaseException) -> str:
    """`reason` of an error; for TorchScript the last of its many lines, which has the reason."""
    lines = str(error).strip().splitlines()
    return lines[-1][:200] if lines and lines[0].endswith(INTERPRETER) else reason(error)


def foreign_policy(name: str, task: Task) -> ForeignPolicy:
    """The policy `name` (`is_foreign`) for a task of its dimensions. Raises UserError."""
    if _is_function(name):
        ask = _function(name)
    elif Path(name).is_file():
        ask = (_onnx if Path(name).suffix == ONNX else _torchscript)(name)
    else:
        raise UserError(f"no policy at {name}: name a file that is there")
    return ForeignPolicy(name, ask, task)


def _is_function(name: str) -> bool:
    return _FUNCTION.fullmatch(name) is not None and not Path(name).exists()


def _function(name: str) -> Callable[[Tensor], Any]:
    function = import_function(name, "--policy")  # its module is imported and run
    return lambda obs: function(obs.to(torch.float32).numpy())


def _torchscript(name: str) -> Callable[[Tensor], Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch prefers torch.export, whose files need pickle
            network = torch.jit.load(name, map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(
            f"{name} is not a TorchScript file: write it with torch.jit.trace(...).save "
            "(docs/your-own.md); checkpoints hold pickles and are not loaded"
        ) from error
    own = next((p.dtype for p in network.parameters() if p.is_floating_point()), torch.float32)
    return lambda obs: network(obs.to(own))


def _onnx(name: str) -> Callable[[Tensor], Any]:
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError(
            f"{name} needs onnxruntime: pip install 'tom-studio[onnx]', or export TorchScript"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(name, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no class
        raise UserError(f"{name} is not a usable ONNX file: export it again") from error
    inputs = session.get_inputs()
    if len(inputs) != 1:
        names = ", ".join(one.name for one in inputs)
        raise UserError(f"{name} takes {names}: export it with one input, observations")
    [given] = inputs
    own = _ONNX_TYPES.get(given.type, np.float32)
    batch = given.shape[0] if given.shape and isinstance(given.shape[0], int) else None

    def ask(obs: Tensor) -> tuple[Tensor, ...]:
        rows = obs.numpy().astype(own)
        if batch is None:
            return tuple(torch.from_numpy(part) for part in session.run(None, {given.name: rows}))
        # Exported without dynamic axes: it takes just so many rows at a time.
        padded = np.concatenate((rows, np.repeat(rows[-1:], -len(rows) % batch, 0)))
        parts = [
            session.run(None, {given.name: padded[i : i + batch]})
            for i in range(0, len(padded), batch)
        ]
        joined = (np.concatenate(outputs)[: len(rows)] for outputs in zip(*parts, strict=True))
        return tuple(map(torch.from_numpy, joined))

    return ask


@dataclass(frozen=True)
class ClonedPolicy:
    """A Gaussian around a network's mean, clipped at the bounds: a `tom.learners.base.Policy`."""

    net: StackedMLP
    centre: Tensor  # (O,) mean and
    spread: Tensor  # (O,) standard deviation of the cloned observations
    std: Tensor  # (A,) of the actions around the mean

    @torch.no_grad()
    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, O): (n, B, A) in [-1, 1]."""
        mean = self.mean(obs)
        noise = torch.randn(n, *mean.shape, generator=generator)
        return (mean + self.std * noise).clamp(-1, 1)

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions (B, A), before clipping."""
        return self.net(((obs - self.centre) / self.spread)[None])[0]


def clone(rows: TensorTransitions, generator: torch.Generator) -> ClonedPolicy:
    """The policy that maximises the likelihood of `rows`' actions, with a constant std."""
    sizes = [rows.obs.shape[1], HIDDEN, HIDDEN, rows.action.shape[1]]
    net = StackedMLP(1, sizes, relu, generator)
    spread, centre = torch.std_mean(rows.obs, 0, correction=0)
    policy = ClonedPolicy(net, centre, spread.clamp(min=1e-6), torch.zeros(sizes[-1]))
    optimiser = torch.optim.AdamW(net.parameters(), LR, weight_decay=WEIGHT_DECAY)
    for _ in range(STEPS):
        optimiser.zero_grad()
        (policy.mean(rows.obs) - rows.action).square().mean().backward()
        optimiser.step()
    with torch.no_grad():
        residual = (policy.mean(rows.obs) - rows.action).square().mean(0).sqrt()
    return ClonedPolicy(net, centre, policy.spread, residual.clamp(min=MIN_STD))
