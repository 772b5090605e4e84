"""Weighings in a store: damaged ones are passed over or named."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tom.errors import UserError
from tom.frames import load
from tom.reports.index import index
from tom.reports.weighing_files import REPORT, WEIGHTS, copy_small, of_run, reports

WHOLE = {"data": "one", "policy": "one", "rows": 3, "results": []}


def weighing(store: Path, name: str, report: object) -> Path:
    path = store / "weighings" / name
    path.mkdir(parents=True)
    (path / REPORT).write_text(json.dumps(report))
    return path


def test_what_is_no_whole_report_on_a_run_is_none_of_its_weighings(tmp_path: Path):
    whole = weighing(tmp_path, "whole", WHOLE)
    weighing(tmp_path, ".unfinished.1.tmp", WHOLE)
    weighing(tmp_path, "other", {**WHOLE, "data": "two"})
    weighing(tmp_path, "list", [WHOLE])
    for missing in WHOLE:
        part = {name: value for name, value in WHOLE.items() if name != missing}
        weighing(tmp_path, f"without-{missing}", part)
    assert of_run(tmp_path, "one") == [whole]


def test_a_damaged_report_is_left_out_of_the_page(tmp_path: Path):
    made = {"command": "tom weigh one", "hours": 1, "versions": {"torch": "2"}}
    report = {**WHOLE, "results": [{"learner": "tom", "seed": 0}], "made": made}
    whole = weighing(tmp_path, "whole", report)
    damaged = weighing(tmp_path, "damaged", [report])
    pq.write_table(pa.table({"tom-s0": np.ones(3, np.float32)}), damaged / WEIGHTS)
    found = [path for path, _ in reports(tmp_path)]
    assert found == [whole]
    assert "| `whole` | `one` | `one` | TOM | 0 | 3 | 1.00 |" in index([], found)
    with pytest.raises(UserError, match="cannot be read"):
        load("damaged", store=tmp_path)


@pytest.mark.parametrize("content", [None, b"no parquet"])
def test_a_weighing_with_damaged_weights_is_named_and_not_copied(
    tmp_path: Path, content: bytes | None
):
    damaged = weighing(tmp_path / "store", "damaged", WHOLE)
    if content is not None:
        (damaged / WEIGHTS).write_bytes(content)
    with pytest.raises(UserError, match=f"{damaged} cannot be read"):
        list(copy_small(tmp_path / "store", "one", tmp_path / "out"))
    assert list((tmp_path / "out").glob("weighings/*")) == []


def test_what_a_link_leads_to_and_a_second_figure_are_not_copied(tmp_path: Path):
    whole, secret = weighing(tmp_path / "store", "whole", WHOLE), tmp_path / "secret"
    pq.write_table(pa.table({"mle-s0": np.ones(3, np.float32)}), whole / WEIGHTS)
    secret.write_text("mine")
    (whole / "profile.csv").symlink_to(secret)
    for figure in ("profile.png", "profile.svg"):
        (whole / figure).touch()
    (copy,) = copy_small(tmp_path / "store", "one", tmp_path / "out")
    assert sorted(path.name for path in copy.iterdir()) == ["profile.png", REPORT, WEIGHTS]
