"""CUDA GPUs made of the CPU, for tests where there is none.

Their tensors are CPU tensors that say `cuda:N`. What a GPU refuses is refused: operands on two
devices, another device's generator, numpy, and in a capture whatever waits for the host. A captured
graph is the list of its calls: none of them is made until it is replayed, and then every one, on
the memory that it was captured with, whatever Python has in mind by then.

They show nothing of kernels, streams or speed. Those are for `pytest -m gpu`.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any
from weakref import WeakSet

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map, tree_map_only

COUNT = 2
"""how many GPUs there are"""
CROSSING = ("copy_", "_to_copy")
"""take operands on two devices"""
INDEXING = ("index", "index_put", "index_put_", "_index_put_impl_")
"""take indices on the host, and send them over"""
WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "is_nonzero")
"""need a GPU's values on the host"""
MAKING = (torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor)
"""make a tensor of Python's values"""

_SET_DATA = Tensor.data.__set__  # pyright: ignore[reportAttributeAccessIssue]


class GpuError(RuntimeError):
    """What CUDA would have said."""


class GpuTensor(Tensor):
    """A tensor of a GPU; `raw` is its memory.

    Torch's own code takes `cuda:N` for `meta:N`, a device that every build of it has.
    """

    raw: Tensor

    @staticmethod
    def __new__(cls, raw: Tensor, index: int) -> "GpuTensor":
        made = Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls,
            raw.size(),
            strides=raw.stride(),
            storage_offset=raw.storage_offset(),
            dtype=raw.dtype,
            device=torch.device("meta", index),
        )
        made.raw = raw
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]
    is_cuda, is_meta = True, False

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise GpuError(f"{func}: this tensor has outlived its GPU, or another thread has it")

    @property
    def gpu(self) -> int:
        return Tensor.device.__get__(self).index  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return torch.device("cuda", self.gpu)

    def __deepcopy__(self, memo: dict[int, Any]) -> "GpuTensor":
        made = self.detach().clone().requires_grad_(self.requires_grad)
        vars(made)["_is_param"] = vars(self).get("_is_param", False)  # as an nn.Parameter has it
        return memo.setdefault(id(self), made)

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.raw.__reduce_ex__(protocol)


class GpuGenerator(torch.Generator):
    """A generator of any device, which draws what the CPU's would."""

    _device: torch.device

    def __new__(cls, device: torch.device | str = "cpu") -> "GpuGenerator":
        made = super().__new__(cls)
        made._device = torch.device(device)
        return made

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self._device


class Stream:
    """An order of calls; here there is one."""

    def __init__(self, device: torch.device | str = "cuda") -> None:
        self.device = torch.device(device)

    def wait_stream(self, stream: "Stream") -> None:
        pass

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *error: object) -> None:
        pass


class Graph:
    """The calls of a capture in order, each with the memory that it was captured with."""

    def __init__(self, launches: Counter[str]) -> None:
        self._launches = launches
        self.calls: list[tuple[Callable[..., Any], Any, Any, list[Tensor]]] = []

    def add(self, func: Any, args: Any, kwargs: Any) -> Any:
        """Record a call. What it would move in place stays as it is."""
        if func._schema.is_mutable:
            self.calls.append((func, args, kwargs, []))
            return _moved(func, args, kwargs)
        found = func(*args, **kwargs)
        made = _new(found, args, kwargs)
        if made:
            self.calls.append((func, args, kwargs, made))
        return found

    def replay(self) -> None:
        self._launches["replay"] += 1
        for func, args, kwargs, made in self.calls:
            found = func(*args, **kwargs)
            if made:
                for own, new in zip(made, _tensors(found), strict=True):
                    own.copy_(new)


class Gpus:
    """The GPUs of a test, and what it made them do."""

    def __init__(self) -> None:
        self.launches: Counter[str] = Counter()
        """kernels by name, and replays"""
        self.waits: Counter[str] = Counter()
        """those for which the host waited"""
        self.waiting_is_an_error = False
        self._capturing: tuple[Graph, int] | None = None
        self._alive: WeakSet[Tensor] = WeakSet()

    def run(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        """A call of an operator, for the GPU that its operands are on or its result is to be on."""
        name = func._schema.name.removeprefix("aten::")
        device = kwargs.get("device")
        index = self._where(func, name, args, kwargs)
        if index is None:
            return func(*args, **kwargs)
        own = {id(x.raw): x for x in tree_iter((args, kwargs)) if isinstance(x, GpuTensor)}
        args, kwargs = tree_map_only(GpuTensor, lambda x: x.raw, (args, kwargs))
        if device is not None:
            kwargs["device"] = torch.device("cpu")
        if self._capturing and self._capturing[1] == index:
            found = self._capturing[0].add(func, args, kwargs)
        else:
            found = func(*args, **kwargs)
            self.launches[name] += bool(func._schema.is_mutable or _new(found, args, kwargs))
        if device is not None and device.type == "cpu":
            return found

        def given(x: Tensor) -> GpuTensor:
            return own[id(x)] if id(x) in own else self._tensor(x, index)

        return tree_map_only(Tensor, given, found)

    def wait(self, name: str) -> None:
        """Told where the host waits for a GPU, which no capture allows, whoever it waits for."""
        self.waits[name] += 1
        if self._capturing:
            raise GpuError(f"{name}: operation not permitted when stream is capturing")
        if self.waiting_is_an_error:
            raise GpuError(f"{name}: called a synchronizing CUDA operation")

    def draw(self, func: Any, device: torch.device, generator: torch.Generator) -> None:
        """Told where random numbers are drawn on `device`."""
        wanted, has = _indexed(device), _indexed(generator.device)
        if wanted != has:
            raise GpuError(f"{func}: expected a '{wanted}' generator but found '{has}'")
        if self._capturing and wanted.type == "cuda":
            raise GpuError(f"{func}: the graph does not know its generator")

    @contextmanager
    def present(self) -> Iterator[None]:
        """Let this thread's calls of torch find them."""
        with _Operators(self), _Functions(self):
            yield

    @contextmanager
    def graph(self, graph: Graph, stream: Stream) -> Iterator[None]:
        self._capturing = graph, stream.device.index or 0
        try:
            yield
        finally:
            self._capturing = None

    def memory_allocated(self) -> int:
        """Bytes of all tensors that are still there, a graph's too."""
        memory = {_memory(x): x.untyped_storage().nbytes() for x in list(self._alive)}
        return sum(memory.values())

    def set_sync_debug_mode(self, mode: str) -> None:
        self.waiting_is_an_error = mode == "error"

    def _tensor(self, raw: Tensor, index: int) -> GpuTensor:
        self._alive.add(raw)
        return GpuTensor(raw, index)

    def _where(self, func: Any, name: str, args: Any, kwargs: dict[str, Any]) -> int | None:
        """The GPU that a call is for, None for the CPU; GpuError where it is for two devices."""
        operands = _tensors((args, kwargs))
        theirs = [x for x in operands if isinstance(x, GpuTensor)]
        device = kwargs.get("device")
        if name in CROSSING:
            ends = [_gpu(x) for x in operands] + ([_gpu_of(device)] if device else [])
            asynchronous = kwargs.get("non_blocking") or args[2:3] == (True,)
            if len(set(ends)) > 1 and not asynchronous:
                self.wait(name)
            return next((end for end in ends if end is not None), None)
        if theirs and name in WAITING:
            self.wait(name)
        number = torch.Tag.pointwise in func.tags  # takes one value from the host
        hosts = [x for x in operands if _gpu(x) is None and not (number and not x.dim())]
        if name in INDEXING and _gpu(args[0]) is not None:
            if hosts or any(x.dtype == torch.bool for x in theirs[1:]):
                self.wait(name)  # to send them, or to know how many are meant
            hosts = []
        places = {x.device for x in theirs} | ({torch.device("cpu")} if hosts else set())
        if device is not None and device.type == "meta":
            places.add(torch.device("cuda", device.index or 0))
        if len(places) > 1:
            found = ", ".join(sorted(map(str, places)))
            raise GpuError(f"{name}: expected all tensors to be on the same device: {found}")
        return next((place.index for place in places if place.type == "cuda"), None)


class _Operators(TorchDispatchMode):
    def __init__(self, gpus: Gpus) -> None:
        super().__init__()
        self._gpus = gpus

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return self._gpus.run(func, args, dict(kwargs or {}))


class _Functions(TorchFunctionMode):
    """What is decided before any operator is called."""

    def __init__(self, gpus: Gpus) -> None:
        super().__init__()
        self._gpus = gpus

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.device:
            return func(*args, **kwargs)
        if func in MAKING:
            return _made(func, args, kwargs)
        if func is Tensor.cuda:
            return args[0].to(torch.device("meta", 0))
        first = args[0] if args and isinstance(args[0], GpuTensor) else None
        if kwargs.get("generator") is not None:
            device = kwargs.get("device") or (first.device if first is not None else "cpu")
            self._gpus.draw(func, torch.device(device), kwargs["generator"])
        if first is not None:
            if func is Tensor.tolist:
                self._gpus.wait("tolist")
                return first.raw.tolist()
            if func in (Tensor.numpy, Tensor.__array__):
                raise TypeError(f"can't convert {first.device} device type tensor to numpy")
            if func == _SET_DATA:
                first.raw = args[1].raw
        args = tree_map(_inside, args)
        return func(*args, **{name: tree_map(_inside, value) for name, value in kwargs.items()})


def _made(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """A tensor of Python's values: made on the host, and sent over."""
    device = kwargs.pop("device", None)
    like = args[0] if args and isinstance(args[0], Tensor) else None
    if func is Tensor.new_tensor and isinstance(like, GpuTensor):
        device, args = device or like.device, (like.raw, *args[1:])
    elif like is not None:
        return like.to(device=_inside(device or like.device), **kwargs)
    made = func(*args, **kwargs)
    return made if device is None else made.to(_inside(device))


def _inside(value: Any) -> Any:
    """A device as torch's own code is told of it; anything else as it is."""
    if isinstance(value, str) and value.partition(":")[0] == "cuda":
        value = torch.device(value)
    if isinstance(value, torch.device) and value.type == "cuda":
        return torch.device("meta", value.index or 0)
    return value


def _indexed(device: torch.device) -> torch.device:
    return torch.device(device.type, device.index or 0)


def _gpu(x: Tensor) -> int | None:
    return x.gpu if isinstance(x, GpuTensor) else None


def _gpu_of(device: torch.device) -> int | None:
    return (device.index or 0) if device.type == "meta" else None


def _tensors(tree: Any) -> list[Tensor]:
    return [x for x in tree_iter(tree) if isinstance(x, Tensor)]


def _new(found: Any, args: Any, kwargs: Any) -> list[Tensor]:
    """What is no view of an operand: a kernel wrote it."""
    known = {_memory(x) for x in _tensors((args, kwargs))}
    return [x for x in _tensors(found) if _memory(x) not in known]


def _memory(x: Tensor) -> int:
    return x.untyped_storage().data_ptr()


def _moved(func: Any, args: Any, kwargs: Any) -> Any:
    """What a call that moves operands in place returns: the first of them, if anything."""
    arguments = func._schema.arguments
    values = dict(zip((a.name for a in arguments), args, strict=False)) | kwargs
    moved = [values[a.name] for a in arguments if a.alias_info and a.alias_info.is_write]
    return moved[0] if func._schema.returns else None


@contextmanager
def emulated() -> Iterator[Gpus]:
    """Let torch find GPUs that are made of the CPU."""
    made = Gpus()

    def submit(pool: ThreadPoolExecutor, call: Callable[..., Any], *args: Any) -> Any:
        return plain_submit(pool, made.present()(call), *args)

    plain_submit = ThreadPoolExecutor.submit
    with pytest.MonkeyPatch.context() as patch, made.present():
        patch.setattr(ThreadPoolExecutor, "submit", submit)
        patch.setattr(torch, "Generator", GpuGenerator)
        for name, value in {
            "is_available": lambda: True,
            "device_count": lambda: COUNT,
            "current_stream": Stream,
            "stream": lambda stream: stream,
            "Stream": Stream,
            "synchronize": lambda device=None: None,
            "CUDAGraph": lambda: Graph(made.launches),
            "graph": made.graph,
            "memory_allocated": made.memory_allocated,
            "set_sync_debug_mode": made.set_sync_debug_mode,
        }.items():
            patch.setattr(torch.cuda, name, value)
        yield made
