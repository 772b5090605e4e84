"""The fp32 matrix product of this machine's CPU: torch's default or oneDNN's, by a probe.

`torch.backends.mkldnn.matmul.fp32_precision = "bf16"` sends fp32 products to oneDNN. On chips
without bf16 matrix units the kernel that runs is plain fp32 and often twice as fast; on others
it may really round to bf16. So it is kept only where it is clearly faster *and* as exact.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import median
from time import process_time
from typing import Any, Literal

import torch
from torch import Tensor

MAX_ERROR = 2e-4  # of a 256-term product of unit normals, against float64; fp32 gives 2e-5 to 4e-5
MIN_GAIN = 1.15  # below this the default stays: a tie must not flip between runs
REPEATS = 7


@dataclass(frozen=True)
class MatmulReport:
    """What the probe found; recorded with the run, because it decides the last bits."""

    chosen: "Backend"
    default_ms: float
    onednn_ms: float
    onednn_error: float

    def record(self) -> dict[str, float | str]:
        return asdict(self)


Backend = Literal["default", "onednn"]


_ONEDNN: Any = torch.backends.mkldnn  # what it holds is made at run time


def use(backend: Backend) -> None:
    """Send this process's fp32 matrix products to `backend`."""
    _ONEDNN.matmul.fp32_precision = "bf16" if backend == "onednn" else "none"


def current() -> Backend:
    """Where this process's fp32 matrix products go."""
    return "onednn" if _ONEDNN.matmul.fp32_precision == "bf16" else "default"


def _milliseconds(product: Callable[[], Tensor]) -> float:
    start = process_time()
    for _ in range(20):
        product()
    return (process_time() - start) * 1000 / 20


def choose_matmul(wanted: Literal["auto", "default", "onednn"] = "auto") -> MatmulReport:
    """Probe both products, set the chosen one for this process and report.

    `auto` takes oneDNN where it is at least 1.15 times faster (median of interleaved repeats) and
    its error against float64 stays fp32-like.
    """
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(256, 256, generator=generator)
    b = torch.randn(256, 256, generator=generator)
    exact = a.double() @ b.double()
    times: dict[str, list[float]] = {"default": [], "onednn": []}
    error = float("inf")
    for _ in range(REPEATS):
        for backend in ("default", "onednn"):
            use(backend)
            times[backend].append(_milliseconds(lambda: a @ b))
            if backend == "onednn":
                error = float(((a @ b).double() - exact).abs().max())
    default_ms, onednn_ms = median(times["default"]), median(times["onednn"])
    better = error <= MAX_ERROR and default_ms >= MIN_GAIN * onednn_ms
    chosen = ("onednn" if better else "default") if wanted == "auto" else wanted
    use(chosen)
    return MatmulReport(chosen, default_ms, onednn_ms, error)
