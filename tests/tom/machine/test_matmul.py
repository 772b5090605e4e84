"""The choice of a matrix product: the same for every process of a machine."""

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from tom.machine import matmul

CHOOSE = "from tom.machine.matmul import choose_matmul; print(choose_matmul().default_ms)"


@pytest.fixture(autouse=True)
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An own folder for what is kept, and this process's product as before."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = matmul.current()
    yield matmul.cache_file()
    matmul.use(before)


def test_another_torch_or_another_cpu_is_another_machine(
    kept: Path, monkeypatch: pytest.MonkeyPatch
):
    assert matmul.cache_file() == kept
    with monkeypatch.context() as another:
        another.setattr("torch.__version__", "1.0")
        assert matmul.cache_file() != kept
    monkeypatch.setattr(matmul, "CPU_LINES", ())  # a CPU of which nothing is known
    assert matmul.cache_file() != kept


X86 = "vendor_id\t: AuthenticAMD\ncpu family\t: 25\nmodel\t: 17\ncpu MHz\t: 2596.142\nflags\t: avx2"
ARM = "BogoMIPS\t: 50.00\nFeatures\t: asimd\nCPU implementer\t: 0x41\nCPU part\t: 0xd0c"


@pytest.mark.parametrize(
    ("cpu", "was", "now"),
    [
        (X86, "AuthenticAMD", "GenuineIntel"),
        (X86, "17", "18"),
        (X86, "avx2", "avx2 avx512_bf16"),
        (ARM, "asimd", "asimd bf16"),
    ],
)
def test_a_cpu_is_told_from_another_kind(cpu: str, was: str, now: str):
    assert matmul.kind_of(cpu) != matmul.kind_of(cpu.replace(was, now))


def test_a_cpu_is_the_same_at_every_start_and_on_every_core():
    assert matmul.kind_of(X86) == matmul.kind_of(X86.replace("2596.142", "1498.9"))
    assert matmul.kind_of(ARM) == matmul.kind_of(ARM.replace("50.00", "48.00"))
    assert matmul.kind_of(f"{X86}\n\n{X86.replace('17', '18')}") == matmul.kind_of(X86)


@pytest.mark.parametrize("chosen", ["default", "onednn"])
def test_what_is_kept_is_used(kept: Path, chosen: matmul.Backend):
    found = matmul.MatmulReport(chosen, default_ms=1.0, onednn_ms=0.9, onednn_error=1e-5)
    kept.parent.mkdir()
    kept.write_text(json.dumps(asdict(found)))
    assert matmul.choose_matmul() == found
    assert matmul.current() == chosen


@pytest.mark.parametrize("wanted", ["default", "onednn"])
def test_a_wish_beats_the_probe_and_is_not_kept(kept: Path, wanted: matmul.Backend):
    found = matmul.choose_matmul()
    assert matmul.choose_matmul(wanted).chosen == matmul.current() == wanted
    assert json.loads(kept.read_text()) == asdict(found)


@pytest.mark.slow
def test_processes_that_start_together_agree(kept: Path):
    started = [
        subprocess.Popen([sys.executable, "-c", CHOOSE], stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    said = {process.communicate()[0].strip() for process in started}
    assert said == {str(json.loads(kept.read_text())["default_ms"])}
    assert list(kept.parent.iterdir()) == [kept]


def test_onednn_is_taken_only_where_it_is_clearly_faster_and_as_exact():
    found = matmul.probe()
    exact = found.onednn_error <= matmul.MAX_ERROR
    faster = found.default_ms >= matmul.MIN_GAIN * found.onednn_ms
    assert found.chosen == ("onednn" if exact and faster else "default")
