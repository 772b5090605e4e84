"""How every command ends when it is interrupted, or when nobody reads what it says."""

import io
import os
import signal
import sys
from pathlib import Path

import pytest

from tom.__main__ import script
from tom.cli import main


def test_ctrl_c_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    os.mkfifo(tmp_path / "plan.yaml")  # reading it waits for good
    monkeypatch.setattr(sys, "argv", ["tom", "sweep", "--file", str(tmp_path / "plan.yaml")])
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    try:
        with pytest.raises(SystemExit) as ended:
            script()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert ended.value.code == 1
    assert capsys.readouterr().err == "tom: stopped\n"


def test_a_pipe_that_nobody_reads_is_no_error_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    read, write = os.pipe()
    os.close(read)
    with io.TextIOWrapper(os.fdopen(write, "wb")) as nobody:
        monkeypatch.setattr(sys, "stdout", nobody)
        assert main(["runs", "--json", "--store", str(tmp_path)]) == 1
        nobody.flush()
