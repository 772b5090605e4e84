"""Files that are replaced, appended to and read: what is read is what was written, or an error."""

import json
import resource
import signal
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tom.data.unpack import DAMAGE
from tom.record.decode import NUMBERS, read_table, write_table
from tom.record.files import JsonLines, read_json_lines, replace, replace_json


def test_a_replacement_that_fails_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "status.json"
    path.write_text("old")

    def half(file):
        file.write(b"ne")
        raise RuntimeError

    with pytest.raises(RuntimeError):
        replace(path, half, sync=True)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_threads_that_write_one_file_leave_it_whole(tmp_path):
    path, content = tmp_path / "view.json", {"numbers": list(range(2000))}
    replace_json(path, content, sync=False)

    def write(_: int) -> None:
        for _ in range(100):
            replace_json(path, content, sync=False)

    with ThreadPoolExecutor(3) as pool:
        writers = [pool.submit(write, i) for i in range(3)]
        while not all(writer.done() for writer in writers):
            assert json.loads(path.read_text()) == content
        for writer in writers:
            writer.result()  # raises what the writer raised
    assert list(tmp_path.iterdir()) == [path]


def test_json_holds_null_for_what_is_not_finite(tmp_path):
    content = {"a": np.float32("nan"), "b": [np.inf, np.int64(3)], "c": {"d": np.array([1.5])}}
    replace_json(tmp_path / "x", content, sync=False)
    assert json.loads((tmp_path / "x").read_text()) == {
        "a": None,
        "b": [None, 3],
        "c": {"d": [1.5]},
    }


def test_half_a_last_line_is_skipped_by_readers_and_cut_off_by_the_next_writer(tmp_path):
    path = tmp_path / "m"
    path.write_bytes(b'{"env_step":1}\n{"env_st')
    rows, problems = read_json_lines(path)
    assert rows == [{"env_step": 1}]
    assert problems == ["m: the last line is half written and was skipped"]
    lines = JsonLines(path)
    lines.cut(lines.size)
    lines.append({"env_step": 2})
    lines.close()
    assert read_json_lines(path) == ([{"env_step": 1}, {"env_step": 2}], [])


def test_damaged_lines_are_named_and_the_others_kept(tmp_path):
    path = tmp_path / "m"
    path.write_bytes(b'{"a":1}\n\xff\x00\n[1]\n{"a":4}\n')
    rows, problems = read_json_lines(path)
    assert rows == [{"a": 1}, {"a": 4}]
    assert problems == [f"m: line {n} is damaged and was skipped" for n in (2, 3)]


def _write_within_40_bytes(path: Path) -> None:
    # The operating system then writes a part of a row, as it does on a full disk.
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40, resource.RLIM_INFINITY))
    lines = JsonLines(path)
    lines.append({"env_step": 1})
    with pytest.raises(OSError, match="is the disk full"):
        lines.append({"env_step": 2, "text": "x" * 100})
    lines.append({"env_step": 3})


def test_a_row_that_does_not_fit_the_disk_leaves_no_part_of_itself(tmp_path: Path):
    writer = get_context("fork").Process(target=_write_within_40_bytes, args=(tmp_path / "m",))
    writer.start()
    writer.join()
    assert writer.exitcode == 0
    assert read_json_lines(tmp_path / "m") == ([{"env_step": 1}, {"env_step": 3}], [])


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
