"""The fp32 matrix product of this machine's CPU: torch's default or oneDNN's, by a probe.

`torch.backends.mkldnn.matmul.fp32_precision = "bf16"` sends fp32 products to oneDNN. On chips
without bf16 matrix units the kernel that runs is plain fp32 and often twice as fast; on others
it may really round to bf16. So it is kept only where it is clearly faster *and* as exact.

The kernel decides the last bits of a run, and a chip may stand at the bound, where two probes
disagree. So a machine is probed once: what was found is kept in a file, and every later process
on the same kind of CPU with the same torch reads it.
"""

import contextlib
import hashlib
import json
import os
import platform
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, Literal

import torch
from torch import Tensor

MAX_ERROR = 2e-4  # of a 256-term product of unit normals, against float64; fp32 gives 2e-5 to 4e-5
MIN_GAIN = 1.15  # below this the default stays: a tie must not flip between runs
REPEATS = 7
X86_LINES = ("vendor_id", "cpu family", "model", "stepping", "flags")
ARM_LINES = ("CPU implementer", "CPU variant", "CPU part", "CPU revision", "Features")
CPU_LINES = X86_LINES + ARM_LINES  # of /proc/cpuinfo


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
    """Set this process's product, and report what this machine's probe found.

    `auto` takes oneDNN where it is at least 1.15 times faster (median of interleaved repeats) and
    its error against float64 stays fp32-like.
    """
    found = _of_this_machine(cache_file())
    report = found if wanted == "auto" else replace(found, chosen=wanted)
    use(report.chosen)
    return report


def probe() -> MatmulReport:
    """Measure both products; this process's choice stays as it is."""
    before = current()
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
    use(before)
    default_ms, onednn_ms = median(times["default"]), median(times["onednn"])
    better = error <= MAX_ERROR and default_ms >= MIN_GAIN * onednn_ms
    return MatmulReport("onednn" if better else "default", default_ms, onednn_ms, error)


def cache_file(what: str = "matmul") -> Path:
    """The file that keeps the probe's answer, or another's, for this kind of CPU and this torch."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tom-studio"
    kind = hashlib.sha256(f"{_cpu()}\n{torch.__version__}".encode()).hexdigest()
    return folder / f"{what}-{kind[:12]}.json"


def _cpu() -> str:
    """What tells one kind of CPU from another, and is the same at every start."""
    with contextlib.suppress(OSError):
        return kind_of(Path("/proc/cpuinfo").read_text())
    return f"{platform.machine()} {platform.processor()}"


def kind_of(cpuinfo: str) -> str:
    """What `/proc/cpuinfo` says of the kind of its first core."""
    first = cpuinfo.split("\n\n")[0].splitlines()
    return "\n".join(line for line in first if line.startswith(CPU_LINES))


def _of_this_machine(path: Path) -> MatmulReport:
    """The answer kept in `path`, or a probe's, kept from now on where the folder can be written."""
    kept = _read(path)
    if kept is not None:
        return kept
    found = probe()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return _keep(found, path)
    except OSError:
        return found


def _read(path: Path) -> MatmulReport | None:
    try:
        report = MatmulReport(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    return report if report.chosen in ("default", "onednn") else None


def _keep(found: MatmulReport, path: Path) -> MatmulReport:
    """Keep `found`; where another process was first, its answer counts."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp") as file:
        json.dump(found.record(), file)
        file.flush()
        try:
            os.link(file.name, path)
        except FileExistsError:
            first = _read(path)
            if first is not None:
                return first
            path.unlink(missing_ok=True)  # damaged: nobody reads it
            os.link(file.name, path)
    return found
