"""Commands of `tom`: in this process, or in one of their own that begins with its imports done."""

import os
import sys
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

import pytest

from tom.cli import main

QUICK = [
    "--preset", "paper", "--tom.q-hidden", "16", "--tom.q-steps", "20", "--footprint", "100",
    "--tom.discriminator-hidden", "16", "--tom.discriminator-steps", "20",
]  # fmt: skip
"""options of a weighing that takes a second"""
OWN_TASK = """
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv

gym.register("Own-v0", PendulumEnv, max_episode_steps=60)


def fallen(obs):
    return obs[:, 0] < -0.9
"""
"""a module of a user's own: a task and its rule of ends"""
PRELOADED = ["tom.training.run", "tom.analysis.weighing", "tom.reports.html"]


def code_of(words: Sequence[str], command: Callable[[list[str]], int] = main) -> int:
    """The exit code of `tom`, or another command, with these words, also if its parser ends it."""
    try:
        return command([*words])
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


def works(words: str, folder: Path) -> str:
    """What `tom` with these words prints, which ends well in a process of its own."""
    done = tom_process(words.split(), folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def fails(words: str, folder: Path, named: str, code: int = 2) -> None:
    """`tom` ends with this code in a process of its own, and the last line has `named` in it."""
    done = tom_process(words.split(), folder)
    assert done.returncode == code, done
    said = done.stderr.strip()
    assert code != 2 or "\n" not in said, said
    assert "Traceback" not in said, said
    assert named in said.splitlines()[-1]


def _command(words: list[str], folder: Path, files: list[Path]) -> None:
    for number, file in enumerate(files, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    os.chdir(folder)
    sys.exit(main(words))
