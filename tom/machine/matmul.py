"""The fp32 matrix product of this machine's CPU: torch's default or oneDNN's, by a probe.

`torch.backends.mkldnn.matmul.fp32_precision = "bf16"` sends fp32 products to oneDNN. On chips
without bf16 matrix units the kernel that runs is plain fp32 and often twice as fast; on others
it may really round to bf16. So it is used only if it is clearly faster *and* as exact.

The kernel determines the last bits of a run, and near the bound two probes may disagree. So a
machine is probed once: the result is stored in a file, which every later process on the same kind
of CPU with the same torch reads.
"""

import contextlib
import hashlib
import json
import os
import platform
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, Literal

import torch

MAX_ERROR = 2e-4  # of a 256-term product of unit normals, against float64; fp32 gives 2e-5 to 4e-5
MIN_GAIN = 1.15  # below this the default is used: a tie must not flip between runs
REPEATS, PRODUCTS = 7, 20
X86_LINES = ("vendor_id", "cpu family", "model", "stepping", "flags")
ARM_LINES = ("CPU implementer", "CPU variant", "CPU part", "CPU revision", "Features")
CPU_LINES = X86_LINES + ARM_LINES  # of /proc/cpuinfo


@dataclass(frozen=True)
class MatmulReport:
    """The probe's result; recorded with the run, because it determines the last bits."""

    chosen: "Backend"
    default_ms: float
    onednn_ms: float
    onednn_error: float


Backend = Literal["default", "onednn"]


_ONEDNN: Any = torch.backends.mkldnn  # its attributes are made at run time


def use(backend: Backend) -> None:
    """Send this process's fp32 matrix products to `backend`."""
    _ONEDNN.matmul.fp32_precision = "bf16" if backend == "onednn" else "none"


def current() -> Backend:
    """The backend of this process's fp32 matrix products."""
    return "onednn" if _ONEDNN.matmul.fp32_precision == "bf16" else "default"


def choose_matmul(wanted: Literal["auto", "default", "onednn"] = "auto") -> MatmulReport:
    """Set this process's backend and report the result of this machine's probe.

    `auto` takes oneDNN if it is at least 1.15 times faster (median of interleaved repeats) and its
    error against float64 is that of fp32.
    """
    path = cache_file()
    there, report = path.exists(), _read(path)
    if report is None:
        report = probe()
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            if there:
                path.unlink(missing_ok=True)  # it is damaged
            with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp") as file:
                json.dump(asdict(report), file)
                file.flush()
                os.link(file.name, path)
        report = _read(path) or report  # another process may have been first
    if wanted != "auto":
        report = replace(report, chosen=wanted)
    use(report.chosen)
    return report


def probe() -> MatmulReport:
    """Measure both backends; this process's choice is not changed."""
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
            start = process_time()
            for _ in range(PRODUCTS):
                _ = a @ b
            times[backend].append((process_time() - start) * 1000 / PRODUCTS)
            if backend == "onednn":
                error = float(((a @ b).double() - exact).abs().max())
    use(before)
    default_ms, onednn_ms = median(times["default"]), median(times["onednn"])
    better = error <= MAX_ERROR and default_ms >= MIN_GAIN * onednn_ms
    return MatmulReport("onednn" if better else "default", default_ms, onednn_ms, error)


def cache_file() -> Path:
    """The file with the probe's result for this kind of CPU and this torch."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tom-studio"
    cpu = f"{platform.machine()} {platform.processor()}"
    with contextlib.suppress(OSError):
        cpu = kind_of(Path("/proc/cpuinfo").read_text())
    kind = hashlib.sha256(f"{cpu}\n{torch.__version__}".encode()).hexdigest()
    return folder / f"matmul-{kind[:12]}.json"


def kind_of(cpuinfo: str) -> str:
    """The lines of `/proc/cpuinfo` that identify the kind of the first core."""
    first = cpuinfo.split("\n\n")[0].splitlines()
    return "\n".join(line for line in first if line.startswith(CPU_LINES))


def _read(path: Path) -> MatmulReport | None:
    try:
        report = MatmulReport(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    return report if report.chosen in ("default", "onednn") else None
