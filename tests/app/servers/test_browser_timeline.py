"""The timeline and the eyes in a real browser: what moves before the server has answered."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from studio_browser import NEEDS_BROWSER, Visit, settle, until
from studio_runs import PENDULUM_TOM

from tom.record.reader import RunReader, at_or_before

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = NEEDS_BROWSER
WATCH = """() => {
  window.seen = [];
  window.addEventListener("tom:step", ({ detail }) => {
    const plots = [...document.querySelectorAll(".plot")];
    const [profile] = plots.filter((p) => p.follows?.traces);
    const [heat] = plots.filter((p) => p.follows?.cursor);
    const line = heat.parentElement.querySelector(".plot-cursor");
    const { xaxis } = heat._fullLayout;
    const place = line.getBoundingClientRect().left - heat.getBoundingClientRect().left;
    seen.push({
      step: detail, fit: document.querySelector(".readout dd").textContent,
      profile: [...profile.data[0].y], address: location.search,
      // in steps, back from where the line is seen
      cursor: xaxis.p2d(place - xaxis._offset), pixel: xaxis.p2d(2) - xaxis.p2d(0),
    });
  });
}"""
"""notes what stands on the page at every step of the timeline, in the same turn of the browser"""


def seen(page: "Page") -> list[dict]:
    return page.evaluate("window.seen")


def moved(page: "Page", key: str) -> dict:
    """What the page shows as soon as a key has moved the timeline."""
    before = len(seen(page))
    page.keyboard.press(key)
    until(page, lambda: len(seen(page)) > before, f"{key} moves nothing")
    return seen(page)[before]


@pytest.mark.quick
def test_the_timeline_moves_numbers_and_profile_before_the_server_hears_of_it(
    visit: Visit,
    own: Path,
) -> None:
    run = RunReader(own / PENDULUM_TOM)
    profiles = run.profiles()
    fits = profiles.env_step.tolist()
    stops = sorted({*fits, *run.evaluation_steps()})
    page = visit.page
    page.goto(visit.links.opened(f"attention?run={PENDULUM_TOM}"))
    for i in range(2):
        page.locator(".js-plotly-plot").nth(i).locator(".nsewdrag").first.wait_for()
    page.evaluate(WATCH)
    for at in range(len(stops) - 2, -1, -1):
        shown = moved(page, "ArrowLeft")
        fit = at_or_before(fits, stops[at])
        assert (shown["step"], shown["fit"]) == (stops[at], f"{fit:,}")
        assert shown["cursor"] == pytest.approx(stops[at], abs=shown["pixel"])
        expected = profiles.bins[fits.index(fit)]
        assert np.array(shown["profile"]) == pytest.approx(expected, rel=6e-3)
        if at == len(stops) - 2:
            assert "step" not in shown["address"]
    settle(page, f"step={stops[0]}")
    number = page.locator(".readout dd").first
    until(page, lambda: number.inner_text() == f"{fits[0]:,}", "the server's fit is another")
    assert moved(page, "ArrowRight")["step"] == stops[1]
    settle(page, f"step={stops[1]}" if len(stops) > 2 else f"run={PENDULUM_TOM}")
    page.go_back()
    page.wait_for_url(lambda address: f"step={stops[0]}" in address)
    until(page, lambda: seen(page)[-1]["step"] == stops[0], "Back leaves the timeline")
    before = len(seen(page))
    page.get_by_role("button", name="Play", exact=True).click()
    page.wait_for_url(lambda address: "step" not in address)  # the end is where it stands usually
    played = [one["step"] for one in seen(page)[before:]]  # by the clock: a slow browser leaves out
    played = played[: played.index(stops[-1]) + 1]
    assert played[0] == stops[0]
    assert played == sorted({*played} & {*stops})
    assert page.locator(".timeline output").inner_text() == f"step {stops[-1]:,}"
    page.get_by_role("button", name="Play", exact=True).wait_for()  # and no longer Pause
