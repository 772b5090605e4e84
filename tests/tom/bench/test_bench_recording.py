import pytest

from tom.bench.recording import cost


def test_shares_are_of_the_training_and_parts_add_up():
    rows = {row.part: row for row in cost(train_s=10.0)}
    for row in rows.values():
        assert row.share_percent == pytest.approx(row.ms / 10.0 / 10)
    names = list(rows)
    parts = sum(rows[name].ms for name in names[: names.index("all files")])
    assert rows["all files"].ms == pytest.approx(parts)
    assert rows["all files and Rerun"].ms == pytest.approx(parts + rows["Rerun"].ms)
