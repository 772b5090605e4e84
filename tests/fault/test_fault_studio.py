"""The studio: several of them on one store, an end without orphans, and hosts that others reach."""

import signal
from pathlib import Path
from threading import Event

import pytest
from faults import config, wait_until
from kernel import alive, descendants
from servers import answers, command_of, is_taken, studio

from app.links import Links
from app.servers import launcher
from tom.record import Store
from tom.record.rerun import viewer
from tom.training.run import train

pytestmark = pytest.mark.fault


def test_of_two_studios_on_one_store_one_is_killed__it_leaves_no_orphan_and_the_other_serves(
    tmp_path: Path,
):
    train(config("mle"), Store(tmp_path), "mle", rerun=False)
    with studio(tmp_path) as (first, port), studio(tmp_path) as (second, other):
        assert port != other
        assert answers(port, "/api/health")
        children = {s.pid: descendants(s.pid) for s in (first, second)}
        reruns = str(viewer.binary())
        assert not [pid for pid in children[second.pid] if command_of(pid).startswith(reruns)]
        first.kill()
        first.wait()
        wait_until(lambda: not any(map(alive, children[first.pid])), seconds=20)
        assert not is_taken(port)
        assert answers(other, "/api/health")
        second.send_signal(signal.SIGTERM)
        assert second.wait(30) == 0
        wait_until(lambda: not any(map(alive, children[second.pid])))


@pytest.mark.quick
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_host_that_others_reach__is_explicit_and_warns_before_anything_starts(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    stopping = Event()
    stopping.set()
    with launcher.serving(Links(str(tmp_path), host), stopping) as (links, running):
        assert (links.host, running) == (host, None)
        warned = "reachable from other machines" in capsys.readouterr().err
    assert warned == (host != "127.0.0.1")
