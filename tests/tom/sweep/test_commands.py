import _thread
import threading
from pathlib import Path

import pytest
from sweeping import until

from tom.record import Store
from tom.sweep.engine import train_all

SMOKE = ("--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun")


def words(name: str, store: Path, *more: str) -> tuple[str, ...]:
    return (*SMOKE, "--store", str(store), "--run-id", name, *more)


@pytest.mark.slow
def test_every_training_is_run_and_its_exit_code_reported(tmp_path: Path):
    good = words("good", tmp_path, "--learner", "mle", "--steps", "60")
    bad = words("bad", tmp_path, "--learner", "mlee")
    assert train_all({"good": good, "bad": bad}, workers=2) == {"good": 0, "bad": 2}
    assert [run.run_id for run in Store(tmp_path).runs()] == ["good"]


@pytest.mark.fault
def test_interrupt_while_several_train__stops_all_with_a_checkpoint(tmp_path: Path):
    """The caller's Ctrl-C: the running training ends as `stopped`, with a checkpoint."""
    store = Store(tmp_path)

    def interrupt() -> None:
        until(lambda: any(run.status.env_step for run in store.runs()))
        _thread.interrupt_main()

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        train_all({"long": words("long", tmp_path, "--learner", "mle", "--steps", "100000")})
    status = store.run("long").status
    assert status.state == "stopped"
    assert "--resume long" in status.reason
