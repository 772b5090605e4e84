"""What holds of every page: damaged, closed and hostile stores, links, zooms, rest."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from streamlit.proto.ForwardMsg_pb2 import ForwardMsg
from streamlit.runtime.scriptrunner_utils.script_run_context import ScriptRunContext
from streamlit.testing.v1 import AppTest
from studio_pages import TIMEOUT_S, Show, draw, figures
from studio_runs import PENDULUM_TOM, ROAD_TOM, change

from app.__main__ import _readable
from app.data import readers, studies, weighings
from app.parts import shortlinks
from app.router import VIEWS
from tom.errors import UserError
from tom.record import Store, layout, manage
from tom.record.reader import RunReader
from tom.reports.report import write_report
from tom.reports.weighing_files import REPORT

pytestmark = pytest.mark.usefixtures("studio")
PAGES = [view.name for view in VIEWS]
PENDULUM, ROAD = "inverted-pendulum", "road-and-rocks"
ALL_PARTS = {  # every page with each of its parts
    "answer": [{}],
    "curves": [{"part": part} for part in ("Curves", "Statistics", "Settings", "Runs")],
    "attention": [
        {"part": part} for part in ("One learner's weights", "Every learner on one buffer")
    ],
    "replays": [{"part": part} for part in ("One episode", "Side by side", "Film", "Rerun")],
    "findings": [{}],
}
EVERYWHERE = [(page, more) for page, parts in ALL_PARTS.items() for more in parts]
everywhere = pytest.mark.parametrize(
    ("page", "more"),
    EVERYWHERE,
    ids=lambda value: value if isinstance(value, str) else value.get("part", ""),
)
OF_PARTS = [(page, more) for page, more in EVERYWHERE if page != "findings"]
PARTS = ("buffer", "checkpoint", "episodes", "fields", "policies", "weights")
LISTED = 0o444
"""the mode of a folder whose names can be listed and whose files cannot be opened"""
REPEATING = {"replays": [5.0, 4.0]}
"""seconds between two looks, which draw nothing, at what may have begun elsewhere"""


def test_the_pages_of_an_empty_store_say_what_to_run(tmp_path: Path, show: Show) -> None:
    show(tmp_path / "new one")
    app = AppTest.from_string("from app.router import run\nrun()", default_timeout=TIMEOUT_S).run()
    assert not app.exception
    commands = [code.value for code in app.code]
    assert any(command.startswith("tom demo") for command in commands)
    assert any("tom train" in command and "'" in command for command in commands)


@pytest.mark.parametrize("view", PAGES)
def test_a_page_at_rest_redraws_nothing(view: str, monkeypatch: pytest.MonkeyPatch) -> None:
    intervals = []
    enqueue = ScriptRunContext.enqueue

    def noted(context: ScriptRunContext, message: ForwardMsg) -> None:
        if message.HasField("auto_rerun"):
            intervals.append(message.auto_rerun.interval)
        enqueue(context, message)

    monkeypatch.setattr(ScriptRunContext, "enqueue", noted)
    draw(view)
    assert intervals == REPEATING.get(view, [5.0])


def test_every_part_of_every_page_is_asked_for_below() -> None:
    assert list(ALL_PARTS) == PAGES
    for page, parts in ALL_PARTS.items():
        controls = [one for one in draw(page).button_group if one.key == "part"]
        named = [option.content for one in controls for option in one.proto.options]
        assert named == [more["part"] for more in parts if more]


# Addresses


def test_a_zoom_on_one_run_is_none_of_another() -> None:
    def zooms(run_id: str) -> list[str]:
        drawn = figures(draw("attention", run=run_id))
        return [figure["layout"]["uirevision"] for figure in drawn]

    first, second = zooms(PENDULUM_TOM), zooms("pendulum-tom-1")
    assert first
    assert not set(first) & set(second)
    assert zooms(PENDULUM_TOM) == first


@pytest.mark.parametrize(
    ("view", "run", "steps", "more"),
    [
        ("attention", PENDULUM_TOM, lambda run: run.profiles().env_step.tolist(), {}),
        ("attention", ROAD_TOM, RunReader.snapshot_steps, {}),
        ("replays", ROAD_TOM, RunReader.evaluation_steps, {}),
        ("replays", ROAD_TOM, RunReader.evaluation_steps, {"part": "Side by side"}),
    ],
)  # fmt: skip
def test_a_link_with_a_step_that_was_not_kept_shows_the_one_before(
    view: str,
    run: str,
    steps: Callable[[RunReader], list[int]],
    more: dict[str, str],
    store: Path,
) -> None:
    first, *others = steps(RunReader(store / run))
    assert others
    app = draw(view, run=run, **more, step=str(first + 1))
    assert app.query_params["step"] == str(first)


def test_a_link_to_a_run_shows_its_task() -> None:
    for run, task in ((PENDULUM_TOM, PENDULUM), (ROAD_TOM, ROAD)):
        app = draw("attention", run=run)
        assert app.selectbox(key="task").value == task
        assert dict(app.query_params) == {"run": run}
    assert draw("attention", run=PENDULUM_TOM, task=ROAD).selectbox(key="task").value == ROAD


def test_a_run_that_is_not_there_is_named(own: Path) -> None:
    manage.trash(Store(own), TRASHED)
    for run in (TRASHED, "no-such-run"):
        said = [warning.value.replace("\\", "") for warning in draw("curves", run=run).warning]
        assert any(run in words for words in said)
    assert not draw("curves", run=PENDULUM_TOM).warning


# Hostile and damaged runs


@everywhere
def test_a_hostile_and_damaged_run_is_shown_beside_the_others(
    page: str, more: dict[str, str], own: Path
) -> None:
    bad = shutil.copytree(own / ROAD_TOM, own / "bad")
    change(bad / layout.CONFIG, learner="<img src=http://evil/x.png>![x](http://evil/y.png)")
    (bad / layout.STATUS).write_text("nonsense")
    (bad / "weights" / "profiles.jsonl").write_text('{"env_step": 1}\n{"bins"')
    app = draw(page, task=ROAD, run="bad", **more)
    if more.get("part") in ("One learner's weights", "Curves", "Runs"):
        assert any("bad" in warning.value for warning in app.warning)
    assert "<img" not in json.dumps(figures(app))
    for element in (*app.markdown, *app.caption, *app.warning, *app.subheader, *app.header):
        assert not re.search(r"(?<!\\)!\[|(?<!\\)<img", element.value)
    for block in app.get("html"):
        assert "<img" not in block.proto.body


def test_names_of_metrics_and_learners_are_shown_as_words(own: Path) -> None:
    metric = "<img src=x>![x](http://evil/y.png) :material/delete:"
    folder = own / PENDULUM_TOM
    (folder / layout.METRICS_TABLE).unlink()
    rows = [{"env_step": step, metric: step, "eval/return": 1.0} for step in (100, 200)]
    (folder / layout.METRICS).write_text("".join(json.dumps(row) + "\n" for row in rows))
    app = draw("curves", run=PENDULUM_TOM, panel=metric)
    (heading, table) = [part for part in app.markdown if "evil" in part.value]
    for shown in (heading.value, heading.proto.help, table.value):
        assert re.sub(r"[\\\u2060]", "", shown.strip("*")).startswith(metric)
        assert not re.search(r"(?<!\\)(!\[|<img|:material)", shown)
    figure = figures(draw("curves", find=PENDULUM_TOM, run=PENDULUM_TOM, x=metric))[0]
    assert figure["layout"]["xaxis"]["title"]["text"].startswith("&lt;img src=x&gt;")
    change(own / ROAD_TOM / layout.CONFIG, learner="<img src=x>")
    names = [line.get("name") for line in figures(draw("attention", run=ROAD_TOM))[0]["data"]]
    assert "&lt;img src=x&gt; policy" in names


# Folders that are closed, or that lie elsewhere


@pytest.mark.usefixtures("modes_count")
@pytest.mark.parametrize("page", PAGES)
def test_a_closed_run_is_named_and_the_others_are_shown(own: Path, page: str):
    (own / PENDULUM_TOM).chmod(0)
    assert _readable(own) == own
    found = readers.listing(str(own))
    assert len(found.runs) == 4
    assert [text.split(":")[0] for text in found.problems] == [PENDULUM_TOM]
    draw(page, run=PENDULUM_TOM)


@pytest.mark.fault
@pytest.mark.usefixtures("modes_count")
@pytest.mark.parametrize(
    ("part", "mode"),
    [*((part, LISTED) for part in PARTS), *((p, 0) for p in ("buffer", "checkpoint", "weights"))],
)
@pytest.mark.parametrize(("page", "more"), OF_PARTS)
def test_a_closed_part_of_a_run_leaves_the_pages_whole(
    own: Path, page: str, more: dict[str, str], part: str, mode: int
):
    for run in (PENDULUM_TOM, ROAD_TOM):
        (own / run / part).chmod(mode)
        draw(page, run=run, **more)


TRASHED = "pendulum-mle-0"
CODE = "f1a5f75e"
"""of the short link to `curves?task=hopper`"""


@pytest.fixture
def filled(own: Path) -> Path:
    """The store with a weighing, a study, a short link and a run in the trash."""
    manage.trash(Store(own), TRASHED)
    weighed, study = own / "weighings/weighed", own / "studies/shipped"
    weighed.mkdir(parents=True)
    report = {"data": PENDULUM_TOM, "policy": PENDULUM_TOM, "rows": 0, "results": []}
    (weighed / REPORT).write_text(json.dumps(report))
    study.mkdir(parents=True)
    write_report(study, "shipped", "a claim", ["found"])
    assert shortlinks.save(own, "curves", "task=hopper") == CODE
    return own


def found(store: Path) -> list[bool]:
    """Whether the pages find the weighing, the study, the run in the trash and the short link."""
    return [
        weighings.weighed(str(store)) == {PENDULUM_TOM},
        studies.report("shipped", *studies.folders(store)) is not None,
        readers.trashed(store) == [TRASHED],
        shortlinks.target(store, CODE) is not None,
    ]


def test_what_lies_behind_a_link_is_not_shown_and_not_written(filled: Path, tmp_path: Path):
    assert found(filled) == [True] * 4
    assert readers.listing(str(filled)).problems == ()
    (tmp_path / "outside").mkdir()
    for name in layout.BESIDE_RUNS:
        (filled / name).mkdir(exist_ok=True)
        (filled / name).rename(tmp_path / "outside" / name)
        (filled / name).symlink_to(tmp_path / "outside" / name)
    assert found(filled) == [False] * 4
    problems = readers.listing(str(filled)).problems
    assert len(problems) == len(layout.BESIDE_RUNS)
    assert all(any(name in problem for problem in problems) for name in layout.BESIDE_RUNS)
    with pytest.raises(UserError, match="link"):
        shortlinks.save(filled, "curves", "task=walker2d")
    assert [path.stem for path in (tmp_path / "outside/.views").iterdir()] == [CODE]
    for page in PAGES:
        draw(page, run=TRASHED)
    draw("curves", part="Runs")
