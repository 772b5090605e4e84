"""How commands end: by signals, which are what they were after it, and where nobody reads."""

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from commands import code_of

from tom.cli import main
from tom.machine.processes import STOPPING, on_stopping

HUP, TERM, INT = signal.SIGHUP, signal.SIGTERM, signal.SIGINT
SMOKE = ("--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke", "--steps", "20")


@pytest.mark.parametrize(
    ("of_hup", "sent", "requests"),
    [
        (signal.SIG_DFL, (INT, INT), 2),
        (signal.SIG_DFL, (HUP, HUP), 1),  # a terminal that closes
        (signal.SIG_DFL, (TERM, HUP), 1),  # the end of a session
        (signal.SIG_DFL, (TERM, TERM), 1),  # from a batch system and from the sweep
        (signal.SIG_DFL, (TERM, INT), 2),
        (signal.SIG_IGN, (HUP,), 0),  # nohup stays nohup
    ],
)
def test_only_ctrl_c_hurries(of_hup: signal.Handlers, sent: tuple[int, ...], requests: int):
    heard: list[int] = []
    before = signal.signal(HUP, of_hup)  # the tests may run under nohup
    try:
        with on_stopping(lambda number, _: heard.append(number)):
            for number in sent:
                signal.raise_signal(number)
    finally:
        signal.signal(HUP, before)
    assert len(heard) == requests


def test_ctrl_c_while_the_modules_are_imported_is_one_line():
    program = """
import signal, sys
from tom.__main__ import script
signal.signal(signal.SIGINT, signal.default_int_handler)  # the tests may run in the background
class Impatient:
    def find_spec(name, *_):
        if name == "pandas":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Impatient)
sys.argv = ["tom", "runs"]
script()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", "tom: stopped\n")


def test_handlers_are_put_back_after_a_command(tmp_path: Path):
    before = [signal.getsignal(number) for number in STOPPING]
    assert code_of(["train", *SMOKE, "--no-rerun", "--store", str(tmp_path / "store")]) == 0
    assert [signal.getsignal(number) for number in STOPPING] == before


def test_a_pipe_that_nobody_reads_is_no_error_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    read, write = os.pipe()
    os.close(read)
    with io.TextIOWrapper(os.fdopen(write, "wb")) as nobody:
        monkeypatch.setattr(sys, "stdout", nobody)
        assert main(["runs", "--json", "--store", str(tmp_path)]) == 1
        nobody.flush()
