"""Checkpoints, data sets and settings are untrusted input: nothing in them is ever executed."""

import ast
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import torch
from faults import stopped

from tom.cli import main
from tom.data.datasets import read_dataset
from tom.errors import UserError
from tom.policy.stored import read_policy
from tom.record import RunReader, Store, checkpoint
from tom.record.export import export
from tom.reports.index import index
from tom.training.resume import resume

pytestmark = pytest.mark.fault

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a stopped run."""
    path = tmp_path_factory.mktemp("made") / "store"
    stopped(Store(path), 130)
    return path


MODULES = ("pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "yaml", "jsonpickle")


def sources() -> list[Path]:
    return [path for package in ("tom", "app") for path in sorted((ROOT / package).rglob("*.py"))]


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    """Every call in a file, by the words it is called with."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.mark.quick
def test_the_source__unpickles_and_evaluates_nothing():
    for path in sources():
        for name, call in calls(path):
            where = f"{path.relative_to(ROOT)}:{call.lineno}"
            keywords = {word.arg: ast.unparse(word.value) for word in call.keywords}
            assert name not in ("eval", "exec", "compile", "__import__"), where
            assert name.partition(".")[0] not in MODULES, where
            if name == "torch.load":
                assert keywords.get("weights_only") == "True", where
            if name == "np.load":
                assert keywords.get("allow_pickle") == "False", where
            if name in ("pd.read_pickle", "np.memmap"):
                pytest.fail(where)
            assert keywords.get("shell", "False") == "False", where


class Evil:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@pytest.mark.quick
def test_code_in_a_checkpoint_with_the_right_hash__is_not_executed_and_the_one_before_is_used(
    store: Store, tmp_path: Path
):
    run = store.run("a")
    folder = run.path / checkpoint.FOLDER
    newest = folder / f"{checkpoint.newest(folder):09d}"
    torch.save({"training": Evil(tmp_path / "executed")}, newest / "state.pt")
    manifest = json.loads((newest / "manifest.json").read_text())
    manifest["sha256"] = hashlib.sha256((newest / "state.pt").read_bytes()).hexdigest()
    (newest / "manifest.json").write_text(json.dumps(manifest))
    done = resume(store, "a", rerun=False)
    assert done.status.state == "finished"
    assert any(newest.name in text for text in done.status.warnings)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("name", ["buffer/000000000.npz", "episodes/000000080.npz", "policy.npz"])
def test_code_in_an_array_file__is_not_executed_and_the_file_named(
    store: Store, tmp_path: Path, name: str
):
    run = store.run("a")
    evil = np.array([Evil(tmp_path / "executed")], dtype=object)
    np.savez(run.path / name, reward_0=evil, obs=evil, weight_0=evil, env=evil)
    reader = RunReader(run.path)
    reader.buffer()
    reader.episodes(80)
    assert name == "policy.npz" or name in reader.problems[0]
    if name == "policy.npz":
        with pytest.raises(UserError, match="is no stored policy"):
            read_policy(run.path / name)
    assert not (tmp_path / "executed").exists()


def test_a_data_set_whose_array_lies_in_another_file__is_refused_in_one_line(tmp_path: Path):
    (tmp_path / "secret").write_bytes(bytes(40))
    with h5py.File(tmp_path / "data.hdf5", "w") as file:
        where = [(str(tmp_path / "secret"), 0, 40)]
        file.create_dataset("rewards", (10,), "f4", external=where)
    with pytest.raises(UserError, match="another file"):
        read_dataset(tmp_path / "data.hdf5")


ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31mred\r\nfake line\u202edrow"
MARKUP = (
    "<img src=x onerror=alert(1)> [x](http://evil.example) ```\n</pre><script>alert(1)</script>"
)
FORMULA = "=cmd|'/C calc'!A1"


def crafted(store: Store, words: str) -> RunReader:
    """A run whose every text is `words`."""
    run = store.run("a")
    description = json.loads((run.path / "config.json").read_text())
    for key in ("learner", "preset", "command", "git_commit"):
        description[key] = words
    description["versions"] = {words: words}
    (run.path / "config.json").write_text(json.dumps(description))
    status = json.loads((run.path / "status.json").read_text())
    status |= {"state": "failed", "phase": words, "reason": words, "warnings": [words]}
    (run.path / "status.json").write_text(json.dumps(status))
    notice = {"env_step": 1, "code": words, "message": words}
    (run.path / "notices.jsonl").write_text(json.dumps(notice) + "\n")
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"env_step": 131, words: 1.0}) + "\n")
    (run.path / "labels.json").write_text(
        json.dumps({"name": words, "tags": [words], "note": words})
    )
    (store.path / f"folder {words.replace('/', '')}").mkdir()
    (run.path / "buffer" / f"0{words.replace('/', '')}.npz").touch()
    return run


@pytest.mark.quick
@pytest.mark.parametrize(
    "verb", [("runs", "list"), ("runs", "show", "a"), ("runs", "verify"), ("doctor",), ("runs",)]
)
def test_terminal_escapes_in_a_run_and_in_folder_names__are_printed_as_plain_words(
    verb: tuple[str, ...], store: Store, capsys: pytest.CaptureFixture[str]
):
    crafted(store, ESCAPES)
    main([*verb, "--store", str(store.path)])
    said = capsys.readouterr()
    for line in (said.out + said.err).split("\n"):
        assert line.isprintable(), line
        assert not line.startswith("fake line")


@pytest.mark.quick
def test_terminal_escapes_in_what_is_asked_for__are_printed_as_plain_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["runs", "show", ESCAPES, "--store", str(tmp_path)]) == 2
    assert main(["runs", "list", "--store", str(tmp_path / ESCAPES.replace("/", ""))]) == 2
    assert all(line.isprintable() for line in capsys.readouterr().err.split("\n"))


@pytest.mark.quick
def test_markup_in_the_settings_of_small_copies__is_plain_words_in_the_page_about_them(
    store: Store,
):
    run = crafted(store, MARKUP)
    page = index([run], [])
    outside, inside = [], ""
    for line in page.split("\n"):
        ticks = re.match("`{3,}", line)
        if ticks and not inside:
            inside = ticks[0]
        elif inside and line.startswith(inside):
            inside = ""
        elif not inside:
            outside.append(line)
    assert not re.search(r"(?<!\\)[<\[]", "\n".join(outside))
    assert inside == ""


@pytest.mark.quick
def test_a_metric_named_as_a_formula__is_a_text_in_the_csv(store: Store, tmp_path: Path):
    run = crafted(store, FORMULA)
    table = pd.read_csv(export(run, "csv", tmp_path / "out"))
    assert "'" + FORMULA in table.columns
    assert not [name for name in table.columns if name[0] in "=+-@"]
