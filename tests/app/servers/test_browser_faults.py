"""What went wrong once for a visitor with a real browser."""

import json
import shutil
import time
from pathlib import Path

import pytest
from studio_runs import PENDULUM_TOM
from test_browser import Visit, own, visit, wait_until_steady  # noqa: F401 (two are fixtures)

from tom.record import layout, manage
from tom.record.files import replace_json
from tom.record.store import Store

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]


def test_a_link_to_a_run_that_is_not_there_says_so(visit: Visit, own: Path) -> None:  # noqa: F811
    manage.trash(Store(own), PENDULUM_TOM)
    page = visit.page
    page.goto(visit.links.opened(f"weights?run={PENDULUM_TOM}"))
    trash = page.get_by_text(f"Run {PENDULUM_TOM} is in the trash")
    trash.wait_for()
    page.get_by_text("Log axis").or_(page.get_by_text("effective sample")).first.wait_for()
    assert trash.is_visible()  # also once the address has been put right
    way_back = page.get_by_role("link", name="Compare, under Runs").get_attribute("href")
    page.goto(f"{visit.links.address}{way_back}")
    page.get_by_text("1 in the trash").wait_for()

    page.goto(f"{visit.links.address}/replays?run=no-such-run")
    said = page.get_by_text("There is no run no-such-run in this store")
    said.wait_for()
    page.get_by_label("Run", exact=True).click()
    page.get_by_role("option", name="Inverted pendulum · MLE · seed 0").click()
    said.wait_for(state="detached")

    page.goto(f"{visit.links.address}/v/0123abcd")
    page.get_by_text("No view is kept as 0123abcd").wait_for()
    page.get_by_role("link", name="open the studio").click()
    page.get_by_text("Nothing is training now").wait_for()


def set_status(run: Path, **changed: object) -> None:
    path = run / "status.json"
    replace_json(path, json.loads(path.read_text()) | changed, sync=False)


def test_an_open_page_takes_up_a_training_that_starts(visit: Visit, own: Path) -> None:  # noqa: F811
    page = visit.page
    page.goto(visit.links.opened())
    page.get_by_text("Nothing is training now").wait_for()
    page.get_by_text("last return").nth(1).wait_for()
    ended = json.loads((own / PENDULUM_TOM / "status.json").read_text())
    (own / PENDULUM_TOM / layout.LOCK).unlink()  # as if another machine wrote it
    set_status(own / PENDULUM_TOM, state="running", heartbeat=time.time() + 25)
    page.get_by_text("1 training now").wait_for()
    cards, busy = page.get_by_text("last return"), page.get_by_test_id("stStatusWidget")
    # The others' cards are gone, and the page is at rest.
    wait_until_steady(page, lambda: cards.count() == 1 and not busy.count(), 3)
    set_status(own / PENDULUM_TOM, state=ended["state"])
    page.get_by_text("Nothing is training now").wait_for()


def test_enter_takes_one_run_and_not_every_match(visit: Visit) -> None:  # noqa: F811
    page = visit.page
    page.goto(visit.links.opened("compare?show=Runs"))
    field = page.get_by_role("combobox", name="Runs to label or to move to the trash")
    field.click()
    field.press_sequentially("pendulum")
    page.get_by_role("option").first.wait_for()
    field.press("Enter")
    page.get_by_text("Move it to the trash").wait_for()
