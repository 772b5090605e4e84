"""Tables on disk: what is read is what was written, or an error."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tom.data.unpack import DAMAGE
from tom.record.decode import NUMBERS, read_table, write_table

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("more", [{}, NUMBERS], ids=["any", "numbers"])
def test_a_changed_bit_is_found(tmp_path: Path, more: dict):
    path, draw = tmp_path / "table.parquet", np.random.default_rng(0)
    written = {"a": draw.random(500), "b": draw.random(500).astype(np.float32)}
    write_table(path, pa.table(written), **more)
    whole, wrong = path.read_bytes(), 0
    for at in draw.integers(0, len(whole), 200):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        try:
            read = read_table(path)
        except DAMAGE:
            continue
        same = list(read) == list(written)
        wrong += not (same and all(np.array_equal(read[n], written[n]) for n in written))
    assert wrong == 0


def test_all_tables_are_written_there():
    writers = [p for p in (ROOT / "tom").rglob("*.py") if "pq.write_table" in p.read_text()]
    assert [path.name for path in writers] == ["decode.py"]
