"""A page that is open while nothing trains costs next to nothing."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from studio_browser import studio_and_browser

from app.links import Links
from app.router import VIEWS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
MEASURED_S, TRIES = 10, 4
"""the first tries may still see the page being drawn"""
SHARE = 0.02
"""of a core, of all servers together"""


@pytest.fixture(scope="module")
def opened(store: Path) -> Iterator[tuple[Links, "Browser"]]:
    with studio_and_browser(store) as studio:
        yield studio


def servers_cpu_s(port: int) -> float:
    """CPU seconds so far of the processes that belong to the studio at `port`."""
    ticks = 0
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
            command = (process / "cmdline").read_bytes()
            fields = (process / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if f'"port": {port}'.encode() in environment and b"app." in command:
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("path", [view.PATH for view in VIEWS])
def test_an_idle_page_costs_at_most_two_hundredths_of_a_core(
    opened: tuple[Links, "Browser"], path: str
) -> None:
    links, browser = opened
    page = browser.new_page()
    page.goto(links.opened(path))
    page.get_by_test_id("stMain").wait_for()
    used = [cpu_s_of_a_while(page, links.port)]
    while used[-1] > SHARE * MEASURED_S and len(used) < TRIES:
        used.append(cpu_s_of_a_while(page, links.port))
    page.close()
    assert servers_cpu_s(links.port) > 0
    assert used[-1] <= SHARE * MEASURED_S, used


def cpu_s_of_a_while(page: "Page", port: int) -> float:
    before = servers_cpu_s(port)
    page.wait_for_timeout(1000 * MEASURED_S)
    return servers_cpu_s(port) - before
