"""Makes and writes a run folder (docs/run-folder.md): files only, no threads."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom import plugins
from tom.config import RunConfig
from tom.data.sampling import bin_means, ess, zero_share
from tom.errors import DISK_FULL, TryLaterError, UserError
from tom.events import Collected, Weights
from tom.record import decode, integrity, layout, lock
from tom.record.decode import NUMBERS, write_table
from tom.record.files import (
    JsonLines,
    read_json,
    read_json_lines,
    replace,
    replace_json,
    sync,
    whole_folder,
)
from tom.record.status import Status
from tom.record.store import Store
from tom.record.versions import machine, made_by

SEGMENT_ROWS = 4096
"""rows up to which a segment of the replay buffer is rewritten when new rows come"""

RESUMING = ("versions", "task", "settings", "checkpoint", "rows")
"""the kinds of notice that a resume begins with"""


class TakenError(UserError):
    """A run of that name exists already."""


class RunWriter:
    """The one writer of a run folder; holds a lock on it until `close`.

    If another machine could not see the lock and took over the folder, every write raises
    LostError.
    """

    def __init__(self, path: Path, config: RunConfig) -> None:
        """Open the run folder `path`. Raises UserError if another process writes it."""
        self.path, self.config, self.run_id = path, config, path.name
        self._lock = lock.acquire(path)
        for folder in (path, *(path / name for name in layout.FOLDERS)):
            folder.mkdir(exist_ok=True)
            for left in folder.glob(".*.tmp"):  # by a killed writer
                if not left.name.startswith(f".{layout.LABELS}"):  # which others write
                    left.unlink(missing_ok=True)
        self._lines = {name: JsonLines(path / name) for name in layout.LINES}
        self._latest_snapshot: int | None = None
        self._tail: dict[str, NDArray] = {}  # the rows of the last segment
        self._tail_first = 0
        self._unsynced: set[Path] = set()

    @classmethod
    def create(
        cls,
        store: Store,
        run_id: str | None,
        config: RunConfig,
        matmul: object = None,
        command: str = "",
    ) -> "RunWriter":
        """The writer of a new run; without an id a generated one, also if two start at once.

        `matmul` is the result of the probe for fast matrix products (any JSON value). The folder
        appears whole, with `config.json`, or not at all. Raises UserError if the id is invalid or
        taken, or if the store cannot be written.
        """
        from tom.record.task_record import description, save_scene  # imports a simulator: a second

        while run_id is None:
            generated = store.new_run_id(config.env, config.learner, config.seed)
            with suppress(TakenError):
                return cls.create(store, generated, config, matmul, command)
        path = store.resolve(run_id)
        task, needed = description(config.env), plugins.needed(config)
        content = {
            "schema": layout.SCHEMA,
            "run_id": run_id,
            "env": config.env,
            "learner": config.learner,
            "seed": config.seed,
            "preset": config.preset,
            "config": config.model_dump(mode="json"),
            **made_by(command),
            "machine": machine(),
            "matmul": matmul,
            "created": datetime.now(UTC).isoformat(),
            **({} if task is None else {"task": task}),
            **({"plugins": needed} if needed else {}),
        }
        try:
            with whole_folder(path) as unfinished:
                replace_json(unfinished / layout.CONFIG, content, sync=True)
                save_scene(config.env, unfinished)
        except OSError as error:
            if path.exists():
                raise TakenError(f"run '{run_id}' exists already: choose another run id") from error
            kind = TryLaterError if error.errno in DISK_FULL else UserError
            raise kind(f"cannot make run {run_id}: {error}") from error
        return cls(path, config)

    def mark(self) -> dict[str, Any]:
        """The sizes of the files, for `rewind`; their rows are on the disk by then.

        Later rows begin a new segment: one that is written anew could be lost with its old rows.
        """
        self._lock.check()
        for lines in self._lines.values():
            lines.sync()
        for path in (*self._unsynced, self.path / layout.BUFFER):
            sync(path)
        self._unsynced.clear()
        self._end_segment()
        return {
            "lines": [lines.size for lines in self._lines.values()],
            "segment": self._tail_first,
            "latest_snapshot": self._latest_snapshot,
        }

    def rewind(self, mark: Mapping[str, Any]) -> None:
        """Go back to `mark`; a resumed training writes everything after it again.

        Notices of an earlier resume stay, because they are not given again: its versions count from
        then on.
        """
        (self.path / layout.DIGESTS).unlink(missing_ok=True)
        (self.path / layout.METRICS_TABLE).unlink(missing_ok=True)
        before, _ = read_json_lines(self.path / layout.NOTICES)
        for lines, size in zip(self._lines.values(), mark["lines"], strict=True):
            lines.cut(size)
        for row in before[len(read_json_lines(self.path / layout.NOTICES)[0]) :]:
            if row.get("code") in RESUMING:
                self.append(layout.NOTICES, row)
        self._latest_snapshot = mark["latest_snapshot"]
        self._tail_first, self._tail = mark["segment"], {}
        for first in layout.numbers(self.path / layout.BUFFER, ".npz"):
            if first >= self._tail_first:
                (self.path / layout.segment(first)).unlink()

    def resumed(self, config: RunConfig, command: str) -> None:
        """Add to `config.json` that the run was resumed, with which code and until which step."""
        description = read_json(self.path / layout.CONFIG)
        description["config"] = config.model_dump(mode="json")
        at = {"at": datetime.now(UTC).isoformat()}
        description.setdefault("resumes", []).append(at | made_by(command))
        replace_json(self.path / layout.CONFIG, description, sync=True)

    def status(self, status: Status) -> None:
        """Replace `status.json`; a final state is also synced to the disk."""
        self._lock.check()
        content = asdict(status)
        replace_json(self.path / layout.STATUS, content, sync=status.state != "running")

    def append(self, name: str, row: Mapping[str, Any]) -> None:
        """Append a row to one of layout.LINES."""
        self._lock.check()
        self._lines[name].append(row)

    def notice(self, env_step: int, code: str, message: str) -> None:
        self.append(layout.NOTICES, {"env_step": env_step, "code": code, "message": message})

    def profile(self, weights: Weights, bins: int) -> None:
        row = {
            "env_step": weights.env_step,
            "count": len(weights.weight),
            "bins": bin_means(weights.weight, bins).numpy(),
            "ess": ess(weights.weight),
            "zeros": zero_share(weights.weight),
            **({} if weights.rows is None else {"rows": weights.rows}),
        }
        self.append(layout.PROFILES, row)

    def snapshot(self, weights: Weights, *, keep: bool) -> None:
        """Write the single weights and their policy; earlier ones are deleted unless kept.

        A policy that was kept for itself (`KeptPolicy`) stays: such weights bring none.
        """
        columns = {"weight": weights.weight}
        if weights.log_ratio is not None:
            columns |= {"log_ratio": weights.log_ratio, **weights.terms}
        if weights.per_dim is not None:
            columns |= {f"dim_{i}": column for i, column in enumerate(weights.per_dim.T)}
        arrays = {name: np.asarray(column, np.float32) for name, column in columns.items()}
        self._table(layout.snapshot(weights.env_step), pa.table(arrays))
        if weights.policy is not None:
            self.arrays(layout.policy(weights.env_step), weights.policy)
        previous, self._latest_snapshot = self._latest_snapshot, weights.env_step
        if previous is not None and previous != weights.env_step:
            (self.path / layout.snapshot(previous)).unlink(missing_ok=True)
            if weights.policy is not None:
                (self.path / layout.policy(previous)).unlink(missing_ok=True)
        if keep:
            self._latest_snapshot = None

    def rows(self, new_rows: Collected) -> None:
        if not len(new_rows.transitions):
            return
        new = decode.transition_arrays(new_rows)
        if len(self._tail.get("policy_version", ())) >= SEGMENT_ROWS:
            self._end_segment()
        name = self._tail_first
        if self._tail:
            new = {part: np.concatenate([self._tail[part], new[part]]) for part in new}
        self._tail = new
        self.arrays(layout.segment(name), new)
        self._unsynced.add(self.path / layout.segment(name))

    def cut(self) -> None:
        """Truncate the last row's episode, unless it has ended."""
        if self._tail:
            self._tail["truncated"][-1] |= not self._tail["terminated"][-1]
            self.arrays(layout.segment(self._tail_first), self._tail)

    def arrays(self, name: str, arrays: Mapping[str, NDArray], *, sync: bool = False) -> None:
        self._lock.check()
        replace(
            self.path / name,
            lambda file: np.savez(file, allow_pickle=False, **arrays),
            sync=sync,
        )

    def metrics_table(self) -> None:
        """Write the Parquet copy of the metrics."""
        rows = decode.metrics_table(read_json_lines(self.path / layout.METRICS)[0])
        table = pa.Table.from_pandas(rows, preserve_index=False)
        self._table(layout.METRICS_TABLE, table, sync=True)

    def digests(self) -> None:
        self._lock.check()
        integrity.write_digests(self.path)

    def close(self) -> None:
        for lines in self._lines.values():
            lines.close()
        self._lock.close()

    def _end_segment(self) -> None:
        self._tail_first += len(self._tail.get("policy_version", ()))
        self._tail = {}

    def _table(self, name: str, table: pa.Table, *, sync: bool = False) -> None:
        self._lock.check()
        replace(self.path / name, lambda file: write_table(file, table, **NUMBERS), sync=sync)
