from pathlib import Path
from typing import Any

import pytest

from tom.bench.report import BEGIN, END, page, put
from tom.cli import main
from tom.errors import UserError

PART = {"part": "SAC update", "ms": 3.7812, "low_ms": 3.68, "high_ms": 3.9, "floor_ms": 2.4}
FOUND: dict[str, Any] = {
    "gflops": 231.4,
    "matmul": "onednn",
    "parts": [
        {**PART, "times_floor": 1.55, "times_ours": None, "target": "<= 1.7 x floor", "met": True},
        {**PART, "times_floor": None, "times_ours": 2.4, "target": ">= 2.5 x ours", "met": False},
    ],
    "hours": [{"env": "hopper", "steps": 125000, "paper_h": 2.3, "mbpo_h": 9.0}],
    "not_measured": ["GPU", "mbrl: pip install it"],
}


def test_the_tables_stand_between_their_marks_and_replace_the_last_ones(tmp_path: Path):
    file = tmp_path / "page.md"
    file.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    put(file, "older")
    put(file, page(FOUND))
    text = file.read_text()
    assert text.startswith(f"before\n{BEGIN}\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    assert text.count("| SAC update | 3.781 | 3.68 to 3.9 |") == 2
    assert "| 1.55 | - | <= 1.7 x floor: met |" in text
    assert "| - | 2.4 | >= 2.5 x ours: **missed** |" in text
    assert "| hopper | 125000 | 2.3 | 9 |" in text
    assert "231 GFLOP/s" in text
    assert "Not measured: GPU; mbrl: pip install it." in text


def test_a_file_without_the_marks_is_refused_before_anything_is_measured(tmp_path: Path, capsys):
    file = tmp_path / "page.md"
    file.write_text("no marks\n")
    with pytest.raises(UserError, match=BEGIN):
        put(file, "text")
    assert main(["bench", "--into", str(file)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert main(["bench", "--into", str(tmp_path / "none")]) == 2
    assert file.read_text() == "no marks\n"
    assert main(["bench", "learn", "--into", str(file)]) == 2
