"""`tom train` with settings that no memory holds."""

from pathlib import Path

import pytest

from tom.cli import main
from tom.record import Store

SMOKE = ["--env", "inverted-pendulum", "--preset", "smoke", "--steps", "250", "--no-rerun"]
BEYOND = ["--rollout.starts", str(2**39), "--rollout.length", str(2**39)]
"""more rows together than 64 bits count, although each setting may be"""


def failed(store: Path, words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """What a training that fails prints on stdout and stderr."""
    assert main(["train", *SMOKE, "--store", str(store), *words]) == 1
    said = capsys.readouterr()
    return said.out, said.err


def test_a_buffer_of_more_rows_than_64_bits_count(capsys, tmp_path: Path):
    _, error = failed(tmp_path, ["--learner", "mle", *BEYOND, "--run-id", "a"], capsys)
    assert "failed: not enough memory" in error
    assert error.count("\n") == 1
    assert "not enough memory" in Store(tmp_path).run("a").status.reason
