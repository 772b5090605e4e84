"""What holds of every page: damaged, closed and hostile stores, links, zooms, rest."""

import json
import re
import shutil
from pathlib import Path

import pytest
from common import change
from streamlit.proto.ForwardMsg_pb2 import ForwardMsg
from streamlit.runtime.scriptrunner_utils.script_run_context import ScriptRunContext
from streamlit.testing.v1 import AppTest
from studio_pages import TIMEOUT_S, Show, draw, figures
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.__main__ import _readable
from app.data import readers
from app.parts import shortlinks
from app.router import VIEWS
from tom.errors import UserError
from tom.record import Store, layout, manage

pytestmark = pytest.mark.usefixtures("studio")
PAGES = [view.name for view in VIEWS]
PENDULUM, ROAD = "inverted-pendulum", "road-and-rocks"
TRASHED = "pendulum-mle-0"
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
AS_TEXT = ("tom_runlist", "tom_frame")
"""parts that make text of what they are given: the runs, and notices of ended trainings"""
HOSTILE = "<img src=http://evil.example/x.png onerror=alert(1)>![x](http://evil.example/y.png)"
REPEATING = {"replays": [5.0, 4.0]}
"""seconds between two looks, which draw nothing, at what may have begun elsewhere"""


def test_the_pages_of_an_empty_store_say_what_to_run(tmp_path: Path, show: Show) -> None:
    show(tmp_path / "new one")
    app = AppTest.from_string("from app.router import run\nrun()", default_timeout=TIMEOUT_S).run()
    assert not app.exception
    commands = [code.value for code in app.code]
    assert any(command.startswith("tom demo") for command in commands)
    assert any("tom train" in command and "'" in command for command in commands)


def test_the_last_runs_come_back_from_the_trash(own: Path) -> None:
    for run in readers.listing(str(own)).runs:
        manage.trash(Store(own), run.run_id)
    app = draw("curves", part="Runs")
    app.multiselect(key="restored").select(TRASHED).run()
    next(button for button in app.button if button.label == "Bring back").click().run()
    assert [run.run_id for run in readers.listing(str(own)).runs] == [TRASHED]
    assert not app.exception


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


def harmless(app: AppTest) -> None:
    """Nothing on the page is markup that came from outside."""
    heads = (*app.header, *app.subheader)
    for element in (*app.markdown, *app.caption, *app.warning, *app.info, *app.error, *heads):
        assert not re.search(r"(?<!\\)!\[x|(?<!\\)<img", element.value), element.value
        assert not re.search(r"(?<![\\`])\]\(http://evil", element.value), element.value
    for block in app.get("html"):
        assert "<img" not in block.proto.body
    for part in app.get("bidi_component"):
        if part.proto.component_name not in AS_TEXT:
            content = json.loads(part.proto.json)
            # Of a chart only the figure: its label and its caption are an attribute and a text.
            assert "<img" not in json.dumps(content.get("figure", content))


@pytest.fixture(
    scope="module", params=[ROAD_TOM, pytest.param(PENDULUM_TOM, marks=pytest.mark.fault)]
)
def hostile(
    request: pytest.FixtureRequest, store: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The store with a copy of a run in which every text is markup and a row is damaged."""
    path = shutil.copytree(store, tmp_path_factory.mktemp("hostile") / "store")
    bad = shutil.copytree(path / request.param, path / "bad")
    settings = json.loads((bad / layout.CONFIG).read_text())["config"] | {"device": HOSTILE}
    words = dict.fromkeys(("learner", "preset", "command", "created"), HOSTILE)
    change(bad / layout.CONFIG, config=settings, **words)
    failed = {"state": "failed", "phase": HOSTILE, "reason": HOSTILE, "warnings": [HOSTILE]}
    change(bad / layout.STATUS, **failed)
    notice = {"env_step": 1, "code": HOSTILE, "message": HOSTILE}
    (bad / "notices.jsonl").write_text(json.dumps(notice) + "\n")
    labels = {"name": HOSTILE, "tags": [HOSTILE], "note": HOSTILE}
    (bad / "labels.json").write_text(json.dumps(labels))
    (bad / layout.METRICS_TABLE).unlink()
    for name in (layout.METRICS, layout.PROFILES):
        (bad / name).write_text("torn\n" + (bad / name).read_text())
    return path


@everywhere
def test_a_hostile_and_damaged_run_is_shown_beside_the_others(
    page: str, more: dict[str, str], hostile: Path, show: Show
) -> None:
    show(hostile)
    app = draw(page, run="bad", panel=HOSTILE, **more)
    if more.get("part") in ("One learner's weights", "Curves", "Runs"):
        assert any("bad" in warning.value for warning in app.warning)
    harmless(app)


@pytest.mark.fault
@everywhere
def test_hostile_words_in_an_address__change_nothing_and_read_nothing_outside(
    page: str, more: dict[str, str], own: Path, tmp_path: Path
) -> None:
    shutil.copytree(own / PENDULUM_TOM, tmp_path / "outside")
    kept = draw(page, **more).session_state["address: read"] - {"part"}
    assert {"run", "task", "find"} <= kept
    for value in ("../outside", "/etc/passwd", "\x00", HOSTILE):
        app = draw(page, **dict.fromkeys([*kept, "frame"], value), **more)
        harmless(app)
        assert "outside" not in " ".join(str(m.value) for m in app.markdown)


@pytest.mark.fault
@everywhere
@pytest.mark.parametrize("chosen", [PENDULUM_TOM, ROAD_TOM])
def test_a_page_open_while_its_run_is_deleted__goes_on_with_the_runs_that_are_left(
    page: str, more: dict[str, str], chosen: str, own: Path
) -> None:
    app = draw(page, run=chosen, **more)
    for gone in (own / chosen, own):
        shutil.rmtree(gone)
        assert not app.run().exception, app.exception[0].message


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
def test_a_closed_run_is_named_and_the_others_are_shown(own: Path):
    (own / PENDULUM_TOM).chmod(0)
    assert _readable(own) == own
    found = readers.listing(str(own))
    assert len(found.runs) == 4
    assert [text.split(":")[0] for text in found.problems] == [PENDULUM_TOM]
    for page in PAGES:
        draw(page, run=PENDULUM_TOM)


def test_folders_beside_the_runs_that_are_links_are_named_and_not_written(
    own: Path, tmp_path: Path
) -> None:
    for name in layout.BESIDE_RUNS:
        (tmp_path / "outside" / name).mkdir(parents=True)
        (own / name).symlink_to(tmp_path / "outside" / name)
    problems = readers.listing(str(own)).problems
    assert all(any(name in problem for problem in problems) for name in layout.BESIDE_RUNS)
    with pytest.raises(UserError, match="link"):
        shortlinks.save(own, "curves", "task=walker2d")
    assert not any((tmp_path / "outside/.views").iterdir())
    draw("curves", part="Runs")
