"""Attention cinema: the story is what the run recorded, and its page needs nothing else."""

import base64
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from loops import of_two
from studio_pages import draw, in_browser
from studio_runs import PENDULUM_TOM, ROAD_TOM, info

from app.data import readers
from app.scenes.film import cinema, has_story, robot_shapes, story
from app.servers.cinema import film_tab, video
from tom.envs.scene import Model, model
from tom.errors import UserError
from tom.record.manage import label
from tom.record.reader import RunReader
from tom.record.store import Store


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_a_story_is_what_the_run_recorded(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    told, profiles = story(run), readers.profiles(run)
    assert told["steps"] == profiles.env_step.tolist()
    assert told["count"] == profiles.count.tolist()
    weights = numbers(told["weights"], "<f4").reshape(len(told["steps"]), told["bins"])
    assert np.exp2(weights) == pytest.approx(np.maximum(profiles.bins, 2.0**-9), rel=1e-5)
    rows = numbers(told["cloud"]["row"], "<i4")
    assert rows[0] == 0
    assert rows[-1] == told["steps"][-1] - 1
    assert len(numbers(told["cloud"]["x"], "<f4")) == len(rows)
    kept = RunReader(store / PENDULUM_TOM).evaluation_steps()
    assert {episode["step"] for episode in told["policy"]} <= set(kept)


def test_a_film_of_several_environments_counts_the_rows_of_the_record(tmp_path: Path) -> None:
    run = RunReader(of_two(tmp_path))
    told, rows = story(run), run.buffer_length()
    assert rows == told["rows"][-1] == told["count"][-1] < told["steps"][-1]
    assert numbers(told["cloud"]["row"], "<i4")[-1] == rows - 1


def test_robots_stand_on_the_floor_as_the_simulator_has_them() -> None:
    found = robot_shapes(model("hopper"), np.array([[0, 1.25, 0, 0, 0, 0]], np.float32))
    ends = numbers(found["ends"], "<i2").reshape(*found["shape"], 2, 3)
    radius = np.array(found["radius"])[:, None]
    lowest = (ends[0, ..., 2] - radius).min()
    highest = (ends[0, ..., 2] + radius).max()
    assert lowest == pytest.approx(0, abs=110)  # millimetres
    assert 1200 < highest < 1700


def test_every_kind_of_solid_is_a_thick_line_along_its_length() -> None:
    xml = """<mujoco><worldbody><body>
      <geom type="capsule" size=".1 .5"/> <geom type="sphere" size=".2" pos="0 0 1"/>
      <geom type="cylinder" size=".1 .5" euler="90 0 0"/>
      <geom type="box" size=".6 .1 .2" euler="0 0 90"/>
    </body></worldbody></mujoco>"""
    found = robot_shapes(Model(mujoco.MjModel.from_xml_string(xml), 0.01), np.zeros((1, 0)))  # pyright: ignore[reportAttributeAccessIssue]
    ends = numbers(found["ends"], "<i2").reshape(*found["shape"], 2, 3)
    assert found["radius"] == [100, 200, 100, 150]
    length = np.abs(ends[0, :, 1] - ends[0, :, 0])
    assert length.tolist() == [[0, 0, 1000], [0, 0, 0], [0, 800, 0], [0, 900, 0]]


def test_the_page_asks_nobody_for_anything(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    told = {**story(run), "title": "</script><img src=x onerror=alert(1)>"}
    page = cinema(told, run.learner, "dark")
    assert "default-src 'none'" in page
    assert not re.search(r"(?:src|href)=[\"']?(?:https?:)?//", page)
    assert page.count("</script>") == 1
    assert "<img" not in page


def test_road_and_rocks_and_runs_without_a_buffer_have_no_story(store: Path) -> None:
    assert not has_story(info(store, ROAD_TOM))
    with pytest.raises(UserError, match="road-and-rocks"):
        story(info(store, ROAD_TOM))


def test_the_page_offers_the_film_under_the_name_that_the_run_has_now(own: Path) -> None:
    app = draw("replays", run=PENDULUM_TOM, part="Film", length="30 s")
    assert any("at half speed" in caption.value for caption in app.caption)
    assert any("--cinema" in caption.value for caption in app.caption)
    label(Store(own), PENDULUM_TOM, name="the long one")
    [film] = app.run().get("iframe")
    assert '"title":"the long one"' in film.proto.srcdoc


@in_browser
def test_the_film_plays_without_a_server_and_becomes_an_mp4(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    page = cinema(story(run), run.learner, "light", 20.0)
    with film_tab(page) as tab:
        asked: list[str] = []
        tab.on("request", lambda request: asked.append(request.url))
        first, last = (tab.evaluate(PICTURE, seconds) for seconds in (0, 20))
        assert first != last
        # The last policy is in it, though it was tried after the last fit.
        tried = RunReader(store / PENDULUM_TOM).evaluation_steps()[-1]
        assert tried > story(run)["steps"][-1]
        assert tab.evaluate("playedNow(LAST).step") == tried
        shares: list[float] = []
        made = base64.b64encode(video(tab, 1.5, lambda share: shares.append(share))).decode()
        assert not asked
        assert shares == [pytest.approx(2 / 3), 1.0]
        tab.goto("about:blank")
        seen = tab.evaluate(LOADED, made)
    assert seen["duration"] == pytest.approx(1.5, abs=0.01)
    assert (seen["width"], seen["height"]) == (1280, 720)


PICTURE = "(seconds) => { film.draw(seconds); return document.querySelector('canvas').toDataURL() }"
LOADED = """(made) => new Promise((resolve, reject) => {
  const video = document.createElement("video");
  video.onloadeddata = () => resolve({
    duration: video.duration, width: video.videoWidth, height: video.videoHeight,
  });
  video.onerror = () => reject(new Error(video.error.message));
  video.src = `data:video/mp4;base64,${made}`;
})"""
