"""The plug-ins of docs/extend.md, run from a folder that is not the source; and what goes wrong."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import fails, works
from same_records import last_row

from tom.record import RunReader

ROOT = Path(__file__).parents[2]
TRAIN = "train --preset smoke --steps 320 --no-rerun --store runs"
PLUGINS = "--plugin surprise.py --plugin reward.py --plugin tasks.py"
PAGE = """
import os, sys
from streamlit.testing.v1 import AppTest
from app.links import Links
os.environ |= Links(store="runs").environment()
from tom import plugins
plugins.load(["surprise.py", "reward.py", "tasks.py"])
from app.router import views
assert [view.PATH for view in views()][-1] == "own-pace"
plugins.Registry("test").page("No icon", "no-icon", print, icon="x")
every = AppTest.from_string("from app.router import run\\nrun()", default_timeout=60)
every.run()
assert not every.exception, every.exception[0].message
plugins.PAGES.pop()
app = AppTest.from_string("from app.router import views\\nviews()[-1].page()", default_timeout=60)
app.run()
assert not app.exception, app.exception[0].message
assert {"example", "other"} <= set(app.dataframe[0].value["run"])
from app.theme import learner_colour
from tom.learners import learner_label
assert (learner_colour("surprise"), learner_label("surprise")) == ("#5f8a1f", "Surprise")
from tom.plugins import CHARTS
from app.data import readers
from app.parts import widgets
run = {run.run_id: run for run in readers.listing("runs").runs}["other"]
curve = widgets.curve(run, "surprise/error")
drawn = CHARTS["surprise/error"]([curve], 300).data[0]
assert list(drawn.y) == list(curve.value) and curve.value[-1] > 0
curves = AppTest.from_string("from app.router import VIEWS\\nVIEWS[1].page()", default_timeout=60)
curves.query_params["run"], curves.query_params["panel"] = "other", "surprise/error"
curves.run()
assert not curves.exception, curves.exception[0].message
from app.parts.form import sections
shown = {name: sections("swimmer", name, "paper") for name in ("surprise", "reward", "tom")}
assert [name for name, groups in shown.items() if "surprise" in groups] == ["surprise"]
assert {s.path: s.default for s in shown["tom"]["sac"]}["sac.discount"] == "0.995"
from tom.studies.returns_cells import PAPER_ENVS
assert len(PAPER_ENVS) == 5 and "swimmer" not in PAPER_ENVS
"""
SETTINGS = """
from tom.config import Config
class Own(Config):
    {}
def register(r): r.learner("a", "T", print, settings=Own)
"""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """The examples in a folder of their own."""
    for path in (ROOT / "docs/examples").glob("*.py"):
        shutil.copy(path, tmp_path)
    return tmp_path


def python(script: str, home: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=home, env=environment, stderr=subprocess.PIPE, text=True
    )
    assert done.returncode == 0, done.stderr


def config(home: Path, run_id: str) -> dict:
    return json.loads((home / "runs" / run_id / "config.json").read_text())


def test_plugins_work_as_the_page_says(home: Path):
    works(f"{TRAIN} --env swimmer --learner reward --run-id example {PLUGINS}", home)
    surprise = "--env swimmer --learner surprise --surprise.steps 50"
    works(f"{TRAIN} {surprise} --run-id other {PLUGINS}", home)
    made = config(home, "other")
    assert made["config"]["surprise"]["steps"] == 50
    assert made["plugins"] == ["surprise.py", "tasks.py"]
    assert made["task"]["obs_names"][0] == "body angle"
    assert "surprise" not in config(home, "example")["config"]

    python(PAGE, home)

    again = "train --resume other --steps 340 --store runs"
    fails(again, home, "--plugin surprise.py")
    fails(f"{again} --plugin surprise.py", home, "--plugin tasks.py")
    works(f"train --resume other --steps 400 --no-rerun --store runs {PLUGINS}", home)
    longer = TRAIN.replace("320", "400")
    works(f"{longer} {surprise} --run-id whole {PLUGINS}", home)
    other, whole = (RunReader(home / "runs" / name) for name in ("other", "whole"))
    assert last_row(other) == last_row(whole)

    weighing = "--learner surprise mle --seeds 0 --footprint 100 --surprise.steps 20 --json"
    said = works(f"weigh other --policy other --store runs {weighing} {PLUGINS}", home)
    assert [row["learner"] for row in json.loads(said)["results"]] == ["surprise", "mle"]
    own = "--preset own --learner surprise --seeds 0 --footprint 100 --json --out own"
    said = works(f"weigh other --policy other --store runs {own} {PLUGINS}", home)
    assert json.loads(said)["config"]["surprise"]["steps"] == 50  # as it was trained with


@pytest.mark.slow
def test_the_studies_know_plugins_tasks_and_learners(home: Path):
    longer = TRAIN.replace("320", "1300")
    works(f"{longer} --env swimmer --learner surprise --run-id mine {PLUGINS}", home)
    asked = f"--env swimmer hopper --preset smoke --store runs --json {PLUGINS}"
    said = works(f"reproduce returns --learner surprise {asked} --out returns", home)
    (row,) = json.loads(said)["summary"]
    assert (row["env"], row["learner"], row["n"]) == ("swimmer", "Surprise", 1)
    assert json.loads(said)["missing"] == []  # of the paper's figure, which has no such learner
    said = works(f"reproduce returns {asked} --out returns".replace("--json", ""), home)
    assert "nan" not in said
    fails("reproduce returns --learner surprise --store runs", home, "unknown learner 'surprise'")

    quick = "--moments 1 --rows 100 --ways uniform recency --store runs"
    fails(f"reproduce footprint mine {quick}", home, "unknown environment 'swimmer'")
    works(f"reproduce footprint mine {quick} {PLUGINS} --out study", home)
    kept = sorted((home / "study/cases").iterdir())
    with (home / "tasks.py").open("a") as file:
        file.write("# another task, maybe\n")
    works(f"reproduce footprint mine {quick} {PLUGINS} --out study", home)
    assert len(list((home / "study/cases").iterdir())) == 2 * len(kept) == 4


@pytest.mark.slow
def test_a_sweep_hands_its_plugins_on_and_changes_no_other_run(home: Path):
    words = "sweep --env inverted-pendulum --preset smoke --steps 210 --store runs --jobs 1"
    works(f"{words} --learner mle", home)
    (before,) = (home / "runs").glob("inverted*")
    said = works(f"{words} --learner mle surprise --surprise.steps 9 {PLUGINS}", home)
    assert "2 of 2 runs finished" in said
    names = sorted(path.name for path in (home / "runs").glob("inverted*"))
    assert len(names) == 2
    assert before.name in names


def test_an_installed_package_is_loaded_and_a_broken_one_left_out(home: Path):
    for name, target in (("own", "reward"), ("broken", "nowhere")):
        folder = home / f"{name}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(f"[tom_studio]\n{name} = {target}\n")
    words = ["-m", "tom", *f"{TRAIN} --env hopper --learner reward --run-id one".split()]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{home}"}
    done = subprocess.run(
        [sys.executable, *words], cwd=home, env=environment, stderr=subprocess.PIPE, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "plug-in broken is left out" in done.stderr
    assert config(home, "one")["plugins"] == ["own"]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "own.py"),
        ("x = 1", "register"),
        ("def register(r): r.learner('tom', 'T', None)", "'tom'"),
        ("def register(r): r.learner('a', 'T', None, 'red')", "#rrggbb"),
        (SETTINGS.format("n: int = 1").replace('"a"', '"rollout"'), "'rollout'"),
        (SETTINGS.format("n: int"), "default"),
        ("def register(r): r.task('hopper', 'Hopper-v5')", "'hopper'"),
        ("def register(r): r.nothing()", "AttributeError"),
        ("def register(r): r.task('odd', 'CartPole-v1')", "Discrete"),
        ("def register(r): r.task('odd', 'Pendulum-v1', settings={'sac': {'hiden': 3}})", "hiden"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_one_line(home: Path, content: str | None, named: str):
    if content is not None:
        (home / "own.py").write_text(content)
    fails("train --env odd --learner mle --steps 9 --plugin own.py", home, named)
    assert not (home / "runs").exists()
