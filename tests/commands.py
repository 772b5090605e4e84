"""Commands of `tom`: in this process, or in one of their own that begins with its imports done."""

import os
import sys
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

from tom.cli import main

PRELOADED = ["tom.training.run", "tom.analysis.weighing", "tom.reports.html"]


def code_of(words: Sequence[str]) -> int:
    """The exit code of `tom` with these words, also if its parser ends it."""
    try:
        return main(words)
    except SystemExit as stop:
        return int(str(stop.code))


def tom_process(
    words: Sequence[str], folder: Path, environment: dict[str, str] | None = None
) -> CompletedProcess[str]:
    """`tom` with these words in `folder`, in a process that nothing of this one reaches.

    It is forked from one that has imported what commands need: that saves two seconds each.
    """
    children = get_context("forkserver")
    children.set_forkserver_preload(PRELOADED)
    with TemporaryDirectory() as name:
        out, error = Path(name, "out"), Path(name, "error")
        child = children.Process(
            target=_command, args=(list(words), folder, environment or {}, out, error)
        )
        child.start()
        child.join()
        assert child.exitcode is not None
        return CompletedProcess(words, child.exitcode, out.read_text(), error.read_text())


def _command(
    words: list[str], folder: Path, environment: dict[str, str], out: Path, error: Path
) -> None:
    for file, number in ((out, 1), (error, 2)):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    os.chdir(folder)
    os.environ.update(environment)
    sys.exit(main(words))
