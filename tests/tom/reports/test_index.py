"""The page on a store's small copies."""

from pathlib import Path

from tom.cli import main
from tom.record import Store
from tom.reports.index import index, small_copies

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "250"]


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
