"""What went wrong once for a visitor with a real browser."""

import json
import time
from pathlib import Path

import pytest
from studio_browser import (
    DRAWN_S,
    NEEDS_BROWSER,
    Visit,
    drawn,
    shown_steps,
    zoom_in,
)
from studio_runs import PENDULUM_TOM, set_status, trains_elsewhere

from tom.record import manage
from tom.record.store import Store

pytestmark = NEEDS_BROWSER


def test_a_link_to_a_run_that_is_not_there_says_so(visit: Visit, own: Path) -> None:
    manage.trash(Store(own), PENDULUM_TOM)
    page = visit.page
    page.goto(visit.links.opened(f"weights?run={PENDULUM_TOM}"))
    page.get_by_text(f"Run {PENDULUM_TOM} is in the trash").wait_for()
    page.get_by_text("share of the whole").or_(page.locator(".js-plotly-plot")).first.wait_for()
    page.goto(f"{visit.links.address}/curves?part=Runs")
    page.get_by_text("1 in the trash").wait_for()

    page.goto(f"{visit.links.address}/replays?run=no-such-run&task=inverted-pendulum")
    said = page.get_by_text("There is no run no-such-run in this store")
    said.wait_for()
    page.locator(".runlist .head .name", has_text="MLE").click()
    page.locator(".runlist .run .name").first.click()
    said.wait_for(state="detached")

    page.goto(f"{visit.links.address}/v/0123abcd")
    page.get_by_text("No view is kept as 0123abcd").wait_for()
    page.get_by_role("link", name="open the studio").click()
    page.get_by_text("Does it help?").wait_for()


def test_an_open_page_takes_up_a_training_that_starts(visit: Visit, own: Path) -> None:
    page = visit.page
    page.goto(visit.links.opened("?task=inverted-pendulum"))
    page.get_by_text("Does it help?").wait_for()
    trains_elsewhere(own / PENDULUM_TOM)
    stop = page.get_by_role("button", name="Stop", exact=False)
    stop.wait_for()
    ended = {"state": "finished", "heartbeat": time.time()}
    set_status(own / PENDULUM_TOM, **ended)
    stop.wait_for(state="detached")
    page.get_by_text("last return").first.wait_for()  # its card stays for a while


def test_a_curve_follows_its_run_and_keeps_what_the_reader_has_zoomed_to(
    visit: Visit,
    own: Path,
) -> None:
    page, run = visit.page, own / PENDULUM_TOM
    trains_elsewhere(run)
    page.goto(visit.links.opened(f"curves?run={PENDULUM_TOM}&find={PENDULUM_TOM}"))
    curve = drawn(page)
    zoomed = zoom_in(curve)
    trains_elsewhere(run)
    record_another_return(run, 5000)
    deadline = time.monotonic() + DRAWN_S
    # While Plotly draws anew there is no data for a moment.
    while curve.evaluate("plot => plot.calcdata?.at(-1)?.at(-1).x") != 5000:
        assert time.monotonic() < deadline, "the curve does not follow its run"
        page.wait_for_timeout(200)
    assert shown_steps(curve) == pytest.approx(zoomed, rel=1e-4)


def record_another_return(run: Path, step: int) -> None:
    (run / "metrics.parquet").unlink()
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"env_step": step, "eval/return": 1.0}) + "\n")


def test_enter_takes_one_run_and_not_every_match(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.links.opened("curves?part=Runs&task=inverted-pendulum"))
    field = page.get_by_role("combobox", name="Runs to label or to move to the trash")
    field.click()
    field.press_sequentially("TOM")
    page.get_by_role("option").first.wait_for()
    field.press("Enter")
    page.get_by_text("Move it to the trash").wait_for()
