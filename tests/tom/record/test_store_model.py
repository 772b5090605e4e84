"""The store against a dictionary: whatever is done to it, and whatever else lies in it."""

import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from recorded import Config

from tom.errors import UserError
from tom.events import Metrics, Tick
from tom.record import RunReader, Store, manage
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter

IDS = st.sampled_from(["a", "b", "run-1", "x.y_z", "A"])
BAD = st.sampled_from(["", "..", "../a", "a/b", ".trash", "a b", "é", "a\0"])


class StoreMachine(RuleBasedStateMachine):
    """`runs` is what the store should list: the steps of each run's metrics, and its state."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.store = Store(self.folder / "store")
        self.runs: dict[str, tuple[list[int], str]] = {}
        self.trash: dict[str, list[tuple[list[int], str]]] = {}
        self.odd: set[str] = set()
        self.open: dict[str, Recorder] = {}

    def teardown(self) -> None:
        for recorder in self.open.values():
            recorder.finish("stopped")
        shutil.rmtree(self.folder)

    @rule(run_id=IDS)
    def begin(self, run_id: str) -> None:
        if run_id in self.runs or run_id in self.odd:
            with pytest.raises(UserError):
                RunWriter.create(self.store, run_id, Config)
            return
        self.open[run_id] = Recorder(RunWriter.create(self.store, run_id, Config))
        self.runs[run_id] = ([], "running")

    @precondition(lambda self: self.open)
    @rule(data=st.data(), steps=st.integers(1, 3))
    def record(self, data: st.DataObject, steps: int) -> None:
        run_id = data.draw(st.sampled_from(sorted(self.open)))
        rows, _ = self.runs[run_id]
        for step in range(len(rows) + 1, len(rows) + 1 + steps):
            self.open[run_id].consume(Metrics(step, {"critic/loss": step / 2}))
            self.open[run_id].consume(Tick(step, "optimise"))
            rows.append(step)

    @precondition(lambda self: self.open)
    @rule(data=st.data(), state=st.sampled_from(["finished", "stopped", "failed"]))
    def end(self, data: st.DataObject, state) -> None:
        run_id = data.draw(st.sampled_from(sorted(self.open)))
        self.open.pop(run_id).finish(state, "because")
        self.runs[run_id] = (self.runs[run_id][0], state)

    @rule(run_id=IDS)
    def put_away(self, run_id: str) -> None:
        if run_id not in self.runs or run_id in self.open:
            with pytest.raises(UserError):
                manage.trash(self.store, run_id)
            return
        manage.trash(self.store, run_id)
        self.trash.setdefault(run_id, []).append(self.runs.pop(run_id))

    @rule(run_id=IDS)
    def bring_back(self, run_id: str) -> None:
        if not self.trash.get(run_id) or run_id in self.runs or run_id in self.odd:
            with pytest.raises(UserError):
                manage.restore(self.store, run_id)
            return
        manage.restore(self.store, run_id)
        self.runs[run_id] = self.trash[run_id].pop()

    @rule(run_id=IDS)
    def a_foreign_folder(self, run_id: str) -> None:
        if run_id not in self.runs:
            (self.store.path / run_id).mkdir(parents=True, exist_ok=True)
            self.odd.add(run_id)

    @rule(run_id=BAD)
    def a_bad_id(self, run_id: str) -> None:
        for action in (self.store.run, self.store.resolve):
            with pytest.raises(UserError):
                action(run_id)
        for change in (manage.trash, manage.restore):
            with pytest.raises(UserError):
                change(self.store, run_id)

    @invariant()
    def the_store_lists_what_it_should(self) -> None:
        listed = {run.run_id: run for run in self.store.runs()}
        assert set(listed) == set(self.runs)
        assert len(self.store.problems) == len(self.odd)
        for run_id, run in listed.items():
            self._same(run, *self.runs[run_id])
        assert manage.trashed(self.store) == sorted(k for k, held in self.trash.items() if held)

    def _same(self, run: RunReader, steps: list[int], state: str) -> None:
        assert run.status.state == state
        table = run.metrics()
        assert table["env_step"].tolist() == steps
        assert not steps or table["critic/loss"].tolist() == [step / 2 for step in steps]
        assert run.problems == []


QUIET = [HealthCheck.too_slow, HealthCheck.data_too_large]
TestStore = StoreMachine.TestCase
TestStore.settings = settings(
    max_examples=8, stateful_step_count=12, deadline=None, suppress_health_check=QUIET
)


@pytest.mark.fault
class TestAnythingDoneToAStore(StoreMachine.TestCase):
    """The store lists, trashes and restores exactly what a dictionary would."""

    settings = settings(
        max_examples=120, stateful_step_count=25, deadline=None, suppress_health_check=QUIET
    )
