"""Errors in one line: why something failed, and what was meant by a name that is unknown."""

import pytest

from tom.errors import reason


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError("\n  the disk\nand more of it\n"), "the disk"),
        (RuntimeError(), "RuntimeError"),  # torch has errors without a word
        (ValueError("x" * 5000), "x" * 200),
    ],
)
def test_why_something_failed_in_one_line(error: Exception, line: str):
    assert reason(error) == line
