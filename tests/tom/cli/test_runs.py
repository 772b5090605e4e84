"""`tom runs` on small runs that were trained for real."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
from commands import refused

from tom.cli import main
from tom.errors import TRY_LATER
from tom.record import lock

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "250"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store")
    for run_id, learner in (("one", "mle"), ("two", "tom")):
        code = main([*TRAIN, "--learner", learner, "--store", str(path), "--run-id", run_id])
        assert code == 0
    return path


def ask(capsys: pytest.CaptureFixture[str], store: Path, *words: str, code: int = 0):
    capsys.readouterr()
    assert main(["runs", *words, "--store", str(store), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def told(capsys: pytest.CaptureFixture[str], store: Path, *words: str, code: int = 0) -> str:
    capsys.readouterr()
    assert main(["runs", "--store", str(store), *words]) == code
    return capsys.readouterr().out


def test_runs_alone_lists(store: Path, capsys):
    assert {row["run_id"] for row in ask(capsys, store)} == {"one", "two"}
    assert "two" in told(capsys, store)
    assert [r["run_id"] for r in ask(capsys, store, "list", "--learner", "mle")] == ["one"]
    assert ask(capsys, store, "list", "--state", "failed") == []
    assert told(capsys, store, "list", "--env", "ant").startswith(f"0 runs in {store}\n")


def test_labels(store: Path, capsys):
    assert (
        ask(capsys, store, "rename", "one", "[bold] the [/first]")["name"] == "[bold] the [/first]"
    )
    assert ask(capsys, store, "tag", "one", "a", "b")["tags"] == ["a", "b"]
    assert ask(capsys, store, "tag", "one", "--remove", "a")["tags"] == ["b"]
    assert ask(capsys, store, "note", "one", "look")["note"] == "look"
    assert [r["run_id"] for r in ask(capsys, store, "list", "--tag", "b")] == ["one"]
    assert "[bold] the [/first]" in told(capsys, store)
    shown = told(capsys, store, "show", "one")
    assert "look" in shown
    assert "eval/return" in shown


def test_diff(store: Path, capsys):
    found = ask(capsys, store, "diff", "one", "two")
    assert found["config.learner"] == ["mle", "tom"]
    assert "config.seed" not in found
    assert "config.learner" in told(capsys, store, "diff", "one", "two")
    assert "matmul" not in found


def test_diff_tells_what_made_other_numbers_of_the_same_settings(store: Path, capsys):
    """The matrix product that the probe chose, and a resume with other versions."""
    path = store / "one/config.json"
    made = json.loads(path.read_text())
    now = made["versions"]["torch"]
    other = made | {
        "matmul": made["matmul"] | {"chosen": "another"},
        "resumes": [{"versions": made["versions"] | {"torch": "9.9.9"}, "git_commit": "other"}],
    }
    shutil.copytree(store / "one", store / "again")
    (store / "again/config.json").write_text(json.dumps(other))
    found = ask(capsys, store, "diff", "one", "again")
    shutil.rmtree(store / "again")
    assert found["matmul"] == [made["matmul"]["chosen"], "another"]
    assert found["versions.torch"] == [now, f"{now}, 9.9.9"]
    assert {*found} == {"matmul", "versions.torch", "git_commit"}


def test_trash_and_restore_move_all_or_nothing(store: Path, capsys):
    writer = lock.acquire(store / "two")
    assert main(["runs", "trash", "one", "two", "--store", str(store)]) == TRY_LATER
    assert "run 'two' is being written" in capsys.readouterr().err
    writer.close()
    assert ask(capsys, store, "trash") == []
    ask(capsys, store, "trash", "one")
    assert [row["run_id"] for row in ask(capsys, store)] == ["two"]
    assert main(["runs", "restore", "one", "three", "--store", str(store)]) == 2
    assert "no run 'three' in the trash" in capsys.readouterr().err
    assert ask(capsys, store, "trash") == ["one"]
    ask(capsys, store, "restore", "one")


def test_verify_and_repair(store: Path, capsys):
    assert ask(capsys, store, "verify") == {"runs": {"one": [], "two": []}, "store": []}
    with (store / "one/notices.jsonl").open("ab") as file:
        file.write(b"{half")
    assert "half written" in told(capsys, store, "verify", code=1)
    assert "blanked out" in told(capsys, store, "repair", "one")
    told(capsys, store, "verify")


def test_export_prune(store: Path, capsys, tmp_path: Path):
    (path,) = ask(capsys, store, "export", "one", "--out", str(tmp_path))
    assert pd.read_csv(path)["env_step"].to_list()[-1] == 250
    (path,) = ask(capsys, store, "export", "one", "--small", "--out", str(tmp_path))
    assert (Path(path) / "config.json").exists()
    (row,) = ask(capsys, tmp_path)
    assert (row["state"], row["small_copy"]) == ("finished", True)
    assert "checkpoint" in row["left_out"]
    assert "finished (a small copy)" in told(capsys, tmp_path)
    assert "checkpoint" in told(capsys, tmp_path, "show", "one")
    again = ["train", "--resume", "one", "--store", str(tmp_path)]
    refused(again, capsys, "small copy, which cannot be resumed")
    freed = ask(capsys, store, "prune", "one", "--keep", "0", "--dry-run")["one"]
    assert freed == ask(capsys, store, "prune", "one", "--keep", "0")["one"]
    assert "freed 0.0 MB" in told(capsys, store, "prune", "one", "--keep", "0")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["show", "three"], "no run 'three'"),
        (["export", "one", "--small", "--format", "csv"], "--format and --small"),
        (
            ["export", "one", "--small", "--keep", "buffer", "--without", "buffer"],
            "both name buffer",
        ),
    ],
)
def test_bad_input(store: Path, capsys, words: list[str], named: str):
    refused(["runs", "--store", str(store), *words], capsys, named)
    assert (store / "one").exists()


def test_a_store_that_is_not_there_is_not_an_empty_one(tmp_path: Path, capsys):
    for words in ("list", "verify", "export", "prune", "trash"):
        where = ["--store", str(tmp_path / "rnus")]
        refused(["runs", words, *where], capsys, "rnus/: name another with --store")
