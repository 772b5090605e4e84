"""Tables on standard output."""

import pytest

from tom.cli.tables import show


def test_in_a_pipe_a_row_is_one_line(capsys: pytest.CaptureFixture[str]):
    show("Title", ("name", "value"), [("half-tom-mended", "0.5"), ("x" * 300, "12")])
    title, *table = capsys.readouterr().out.splitlines()
    assert title == "Title"
    assert len(table) == 3 + 2 + 1  # head with its rules, two rows, the last rule
    assert "│ half-tom-mended" in table[3]
    assert table[3].endswith("   0.5 │")
    assert "x" * 300 in table[4]
