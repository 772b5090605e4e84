"""The files of Rerun's viewer: a page that stays local, and no server left behind."""

import json
import os
import re
from pathlib import Path

from kernel import descendants

from tom.record.rerun import viewer


def test_the_page_asks_no_other_host():
    page = b"""<html><head>
      <link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />
      <link
        href="https://fonts.googleapis.com/css2?family=Inter" rel="stylesheet" />
      <link rel="icon" href="favicon.ico" /></head></html>"""
    local = viewer.local_page(page)
    assert b"fonts." not in local
    assert b"favicon.ico" in local
    assert local.index(b"window.fetch =") < local.index(b"favicon.ico")


def test_the_viewer_is_unpacked_and_leaves_no_server_of_reruns(tmp_path: Path):
    viewer.unpack(tmp_path / "rerun")
    assert {path.name for path in (tmp_path / "rerun").iterdir()} == set(viewer.FILES)
    page = (tmp_path / "rerun" / viewer.PAGE).read_bytes()
    assert b"googleapis" not in page
    assert re.search(rb"<script>.*window.fetch = .*</script>", page, re.DOTALL)
    assert (tmp_path / "rerun" / "re_viewer_bg.wasm").read_bytes().startswith(b"\0asm")
    assert [path.name for path in tmp_path.iterdir()] == ["rerun"]
    assert descendants(os.getpid()) == set()


def test_rerun_sends_no_statistics(tmp_path: Path):
    settings = Path(viewer.without_analytics(tmp_path)["XDG_CONFIG_HOME"]) / "rerun"
    assert json.loads((settings / "analytics.json").read_text())["analytics_enabled"] is False
