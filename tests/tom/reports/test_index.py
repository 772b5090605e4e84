"""The page on a store's small copies."""

import json
from pathlib import Path

import pytest

from tom.cli import main
from tom.record import Store
from tom.reports.index import index, short_command, small_copies

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "250"]


@pytest.mark.parametrize(
    ("command", "short"),
    [
        ("tom train --env=ant --seed=12 --run-id=a --no-rerun", "tom train --env=ant --seed=N"),
        ("tom train --seed 3 --store x --steps 5", "tom train --seed N --steps 5"),
        ("tom weigh a --policy b --seeds 0 1 --out x", "tom weigh a --policy b --seeds 0 1"),
        ("tom weigh --out x a --policy b", "tom weigh a --policy b"),
        ("tom weigh --store=x a --seed 3 b", "tom weigh a --seed N b"),
        ("tom train --no-rerun a --run-id b c", "tom train a c"),
        ("tom train --seed=3 4", "tom train --seed=N 4"),
        ("", ""),
        ("tom train don't", "tom train don't"),
    ],
)
def test_a_command_is_told_without_where_it_wrote(command: str, short: str):
    assert short_command(command) == short


def test_small_copies_alone_are_listed_with_their_numbers(tmp_path: Path, capsys):
    store, out = tmp_path / "store", tmp_path / "out"
    assert main([*TRAIN, "--learner", "mle", "--store", str(store), "--run-id", "one"]) == 0
    assert main(["runs", "index", "--store", str(store)]) == 2
    assert "tom runs export --small" in capsys.readouterr().err
    assert main(["runs", "export", "--small", "--store", str(store), "--out", str(out)]) == 0
    assert main(["runs", "index", "--store", str(out)]) == 0
    page = (out / "README.md").read_text()
    (copy,) = small_copies(Store(out))
    assert page == index([copy], [])
    (out / "README.md").write_text("mine")
    assert main(["runs", "index", "--store", str(out)]) == 2
    assert "move it away" in capsys.readouterr().err
    assert (out / "README.md").read_text() == "mine"
    run = Store(store).run("one")
    score = f"{run.status.last_return:.1f}"
    assert f"| `one` | MLE | smoke | 0 | 250 | {score} |" in page
    assert str(run.config["git_commit"])[:10] in page
    assert f"torch {run.config['versions']['torch']}" in page
    assert main(["runs", "export", "--keep", "buffer", "--store", str(store)]) == 2
    assert main(["runs", "export", "--without", "snapshots", "--store", str(store)]) == 2


def test_the_commits_of_resumes_are_told_too(tmp_path: Path):
    assert main([*TRAIN, "--learner", "mle", "--store", str(tmp_path), "--run-id", "one"]) == 0
    config = Store(tmp_path).run("one").config
    resumes = [{"git_commit": config["git_commit"]}, {"git_commit": "0123456789abcdef-dirty"}]
    (tmp_path / "one" / "config.json").write_text(json.dumps({**config, "resumes": resumes}))
    assert ", 0123456789-dirty |" in index([Store(tmp_path).run("one")], [])
