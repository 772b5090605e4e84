from pathlib import Path

import pytest

from tom.record import Store
from tom.sweep import Command, run_commands

SMOKE = ("--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun")


def job(name: str, store: Path, *more: str) -> Command:
    return Command(
        name, (*SMOKE, "--store", str(store), "--run-id", name, *more), store / f"{name}.log"
    )


@pytest.mark.slow
def test_every_job_is_run_and_its_exit_code_reported(tmp_path: Path):
    ended: list[str] = []
    jobs = [
        job("good", tmp_path, "--learner", "mle", "--steps", "60"),
        job("bad", tmp_path, "--learner", "mlee"),
    ]
    codes = run_commands(jobs, workers=2, finished=lambda j, code: ended.append(j.name))
    assert codes == {"good": 0, "bad": 2}
    assert sorted(ended) == ["bad", "good"]
    assert "did you mean 'mle'" in (tmp_path / "bad.log").read_text()
    assert [r.run_id for r in Store(tmp_path).runs()] == ["good"]


@pytest.mark.fault
def test_interrupt_while_several_train__stops_all_with_a_checkpoint(tmp_path: Path):
    """The caller's Ctrl-C: the running training ends as `stopped`, with a checkpoint."""
    long = job("long", tmp_path, "--learner", "mle", "--steps", "100000")

    def interrupt(job: Command, code: int) -> None:
        raise KeyboardInterrupt

    first = job("first", tmp_path, "--learner", "mle", "--steps", "600")
    with pytest.raises(KeyboardInterrupt):
        run_commands([long, first], workers=2, finished=interrupt)
    status = Store(tmp_path).run("long").status
    assert status.state == "stopped"
    assert "--resume long" in status.reason
