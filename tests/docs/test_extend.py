"""The examples of docs/extend.md, applied to a copy of the code and run."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STEP = re.compile(
    r"(?:New file `(?P<new>[^`]+)`|In `(?P<old>[^`]+)`, below `(?P<line>[^`]+)`):\n\n"
    r"```python\n(?P<code>.*?)```",
    re.DOTALL,
)
TRAIN = (
    "-m tom train --env swimmer --learner reward --preset smoke --steps 250 "
    "--no-rerun --run-id example --store"
)
PAGE = """
from streamlit.testing.v1 import AppTest
from app.links import Links
import os, sys
os.environ |= Links(store=sys.argv[1]).environment()
app = AppTest.from_string("from app.views import pace\\npace.page()", default_timeout=60).run()
assert not app.exception, app.exception[0].message
assert app.dataframe[0].value["run"].to_list() == ["example"]
from app.router import VIEWS
assert VIEWS[-1].PATH == "pace"
from tom.record import RunReader
profiles = RunReader(sys.argv[1] + "/example").profiles()
assert 0 < profiles.ess[-1] < 0.999
"""


def apply(match: re.Match[str], root: Path) -> None:
    """Write the new file, or put the lines below the first one that begins as it is said."""
    if match["new"]:
        (root / match["new"]).write_text(match["code"])
        return
    path = root / match["old"]
    lines = path.read_text().splitlines(keepends=True)
    places = [i for i, text in enumerate(lines) if text.startswith(match["line"])]
    assert places, f"{match['old']} has no line {match['line']}"
    lines.insert(places[0] + 1, match["code"])
    path.write_text("".join(lines))


def python(words: list[str], root: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *words],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def extended(tmp_path: Path) -> Path:
    """The code with every example of the page in it."""
    for package in ("tom", "app"):
        shutil.copytree(ROOT / package, tmp_path / package)
    steps = list(STEP.finditer((ROOT / "docs/extend.md").read_text()))
    assert len(steps) == 7
    for step in steps:
        apply(step, tmp_path)
    return tmp_path


def test_a_new_learner_env_and_page_work_as_the_page_says(extended: Path):
    store = str(extended / "store")
    python([*TRAIN.split(), store], extended)
    python(["-c", PAGE, store], extended)
