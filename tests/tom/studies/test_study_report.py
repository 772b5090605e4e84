"""The report of a study says what was met, what was not, and what was not judged."""

from pathlib import Path

from tom.studies.report import write_study

ROWS = [
    {"name": "return", "value": 1.0, "met": True},
    {"name": "success", "value": 0.2, "met": False},
    {"name": "for comparison", "value": 3.0, "met": None},
]


def test_what_is_met_and_what_is_not(tmp_path: Path):
    said = ["TOM is higher on 1 of 4 seeds: the paper says otherwise."]
    made = write_study(tmp_path, "Title", "the paper's claim", said, ROWS, [], seeds="0-3")
    text = made.read_text()
    assert said[0] in text
    assert "1 of 2 figures of our acceptance are met." in text
    assert "Not met: success." in text
    assert "0-3" in text
    assert "the paper&#x27;s claim" in text


def test_all_met(tmp_path: Path):
    text = write_study(tmp_path, "Title", "claim", [], ROWS[:1], []).read_text()
    assert "1 of 1 figures of our acceptance are met." in text
    assert "Not met" not in text
