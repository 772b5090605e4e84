"""A step of training as one CUDA graph.

On a GPU such a step is some hundred kernels of a few microseconds each, and launching them takes
longer than running them. A captured step has one launch.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import torch
from torch import Tensor

WARM_UP = 3  # calls before the capture, so that libraries have allocated their memory


def graphed(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of CUDA tensors, captured after a few calls, once for each set of shapes.

    It must change everything else in place, draw no random numbers and never read a value on the
    host. Its result is overwritten by its next call. With CPU tensors it is called directly.
    """
    known: dict[tuple[torch.Size, ...], _Capture] = {}

    def call(*inputs: Tensor) -> Any:
        if inputs[0].device.type != "cuda":
            return function(*inputs)
        shapes = tuple(x.shape for x in inputs)
        if shapes not in known:
            known[shapes] = _Capture(function, inputs[0].device)
        return known[shapes](inputs)

    return call


class Stepped(Protocol):
    """Networks and their optimisers, updated by `step`, which is one captured graph on a GPU."""

    capture: Callable[..., Any] | None
    """the captured `step`"""

    @property
    def device(self) -> torch.device: ...

    @property
    def step(self) -> Callable[..., Any]: ...


def captured_step(subject: Stepped) -> Callable[..., Any]:
    """The subject's `step`; on a GPU as one graph over the current memory of its tensors."""
    if subject.device.type != "cuda":
        return subject.step
    if subject.capture is None:
        subject.capture = graphed(subject.step)
    return subject.capture


class _Capture:
    """One function at one set of shapes."""

    def __init__(self, function: Callable[..., Any], device: torch.device) -> None:
        self._function = function
        self._device = device
        self._calls = 0
        self._graph = torch.cuda.CUDAGraph()
        self._inputs: tuple[Tensor, ...] = ()
        self._output: Any = None

    def __call__(self, inputs: tuple[Tensor, ...]) -> Any:
        self._calls += 1
        if self._calls <= WARM_UP:
            return self._on_side_stream(inputs)
        if self._calls == WARM_UP + 1:
            self._inputs = tuple(x.clone() for x in inputs)
            with torch.cuda.graph(self._graph, stream=_side_stream(self._device)):
                self._output = self._function(*self._inputs)  # recorded, not run
        for static, x in zip(self._inputs, inputs, strict=True):
            static.copy_(x)
        self._graph.replay()
        return self._output

    def _on_side_stream(self, inputs: tuple[Tensor, ...]) -> Any:
        """A call on the capture's stream instead of the default one."""
        here, side = torch.cuda.current_stream(self._device), _side_stream(self._device)
        side.wait_stream(here)
        with torch.cuda.stream(side):
            output = self._function(*inputs)
        here.wait_stream(side)
        return output


@cache
def _side_stream(device: torch.device) -> torch.cuda.Stream:
    """The stream of all captures on this device, which need not be the current device.

    A stream of another device would silently record nothing; a shared stream has one workspace.
    """
    return torch.cuda.Stream(device)
