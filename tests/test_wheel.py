"""The wheel: it holds the whole of `app` and `tom` and nothing else, and works without the tree."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tom.record import Store

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built by the project's own build backend, which the test extra brings: no network."""
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    return built


def test_it_holds_every_file_of_both_packages_and_nothing_else(wheel: Path):
    with zipfile.ZipFile(wheel) as content:
        names = {name for name in content.namelist() if ".dist-info/" not in name}
        (commands,) = (n for n in content.namelist() if n.endswith(".dist-info/entry_points.txt"))
        assert "tom = tom.__main__:script" in content.read(commands).decode()
    files = [path for package in ("app", "tom") for path in (ROOT / package).rglob("*")]
    kept = {str(path.relative_to(ROOT)) for path in files if path.is_file()}
    assert names == {name for name in kept if "__pycache__" not in name}
    assert "app/parts/plot/plot.js" in names


@pytest.mark.slow
def test_the_demo_runs_from_an_installed_wheel(wheel: Path, tmp_path: Path):
    venv, empty = tmp_path / "venv", tmp_path / "empty"
    empty.mkdir()
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    python = venv / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-index"]
    subprocess.run([*install, "--no-deps", str(wheel)], check=True, capture_output=True)
    # The dependencies of this environment, behind what is installed in the new one.
    (places,) = (venv / "lib").glob("python*/site-packages")
    (places / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    outside = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL"))}

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, cwd=empty, env=outside, capture_output=True, text=True)

    where = run(str(python), "-c", "import app, tom; print(app.__file__, tom.__file__)").stdout
    assert where.split() == [str(places / name / "__init__.py") for name in ("app", "tom")]
    # The demo of a clone trains beside the examples, which have its settings.
    example = "inverted-pendulum-tom-s0-733a5aa5"
    shutil.copytree(ROOT / "runs" / example, empty / "runs" / example)
    done = run(str(venv / "bin" / "tom"), "demo", "--headless")
    assert done.returncode == 0, done.stderr
    runs = [run for run in Store(empty / "runs").runs() if run.run_id != example]
    assert [run.status.state for run in runs] == ["finished"] * 5
    assert {path.name for path in empty.iterdir()} == {"runs"}
