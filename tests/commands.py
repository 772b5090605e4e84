"""Commands of `tom`: in this process, or in one of their own that begins with its imports done."""

import os
import sys
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

import pytest

from tom.cli import main

PRELOADED = ["tom.training.run", "tom.analysis.weighing", "tom.reports.html"]


def code_of(words: Sequence[str]) -> int:
    """The exit code of `tom` with these words, also if its parser ends it."""
    try:
        return main(words)
    except SystemExit as stop:
        return int(str(stop.code))


def refused(words: Sequence[str], capsys: pytest.CaptureFixture[str], named: str = "") -> None:
    """`tom` cannot use these words: exit code 2, and one line with `named` in it."""
    capsys.readouterr()
    code, said = code_of(words), capsys.readouterr()
    assert (code, said.out, said.err.count("\n")) == (2, "", 1), said
    assert named in said.err


def tom_process(words: Sequence[str], folder: Path) -> CompletedProcess[str]:
    """`tom` with these words in `folder`, in a process that changes nothing in this one.

    It is forked from one that has imported what commands need: that saves two seconds each.
    """
    children = get_context("forkserver")
    children.set_forkserver_preload(PRELOADED)
    with TemporaryDirectory() as name:
        files = [Path(name, stream) for stream in ("out", "error")]
        child = children.Process(target=_command, args=(list(words), folder, files))
        child.start()
        child.join()
        assert child.exitcode is not None
        return CompletedProcess(words, child.exitcode, *(file.read_text() for file in files))


def _command(words: list[str], folder: Path, files: list[Path]) -> None:
    for number, file in enumerate(files, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    os.chdir(folder)
    sys.exit(main(words))
