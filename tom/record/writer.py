"""Makes and writes a run folder (docs/run-folder.md): files only, no threads."""

import os
from collections.abc import Mapping
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
from tom.data.transitions import Transitions
from tom.data.unpack import read_arrays
from tom.errors import DISK_FULL, TryLaterError, UserError
from tom.events import Weights
from tom.record import decode, integrity, layout, lock
from tom.record.decode import NUMBERS, write_table
from tom.record.files import (
    JsonLines,
    begins_with,
    json_line,
    read_json,
    replace,
    replace_json,
    sync,
    whole_folder,
)
from tom.record.reader import RunReader
from tom.record.status import Status
from tom.record.store import Store
from tom.record.versions import git_commit, machine, versions

SEGMENT_ROWS = 4096
"""rows up to which a segment of the replay buffer is rewritten when new rows come"""

RESUMING = ("versions", "task", "settings", "checkpoint")
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
        self.path = path
        self.config = config
        self.run_id = path.name
        taken_over = lock.written_here(path) is False
        self._lock = lock.acquire(path)
        _prepare(path)
        if taken_over:
            _renew(path)
        self._metrics = JsonLines(path / layout.METRICS)
        self._profiles = JsonLines(path / layout.PROFILES)
        self._notices = JsonLines(path / layout.NOTICES)
        self._latest_snapshot: int | None = None
        self._tail: dict[str, NDArray] = {}  # the rows of the last segment
        self._tail_first = 0
        self._unsynced: set[Path] = set()

    @classmethod
    def create(
        cls,
        store: Store,
        run_id: str,
        config: RunConfig,
        matmul: object = None,
        command: str = "",
    ) -> "RunWriter":
        """The writer of a new run.

        `matmul` is the result of the probe for fast matrix products (any JSON value). The folder
        appears whole, with `config.json`, or not at all. Raises UserError if the id is invalid or
        taken, or if the store cannot be written.
        """
        from tom.record.task_record import save_scene  # a simulator takes a second to import

        path = store.resolve(run_id)
        store.ensure_writable()
        taken = TakenError(f"run '{run_id}' exists already: choose another run id")
        if os.path.lexists(path):
            raise taken
        try:
            with whole_folder(path) as unfinished:
                for folder in layout.FOLDERS:
                    (unfinished / folder).mkdir()
                content = _description(run_id, config, matmul, command)
                replace_json(unfinished / layout.CONFIG, content, sync=True)
                save_scene(config.env, unfinished)
        except OSError as error:
            if path.exists():  # another writer was first
                raise taken from error
            kind = TryLaterError if error.errno in DISK_FULL else UserError
            raise kind(f"cannot make run {run_id}: {error}") from error
        return cls(path, config)

    def mark(self) -> dict[str, Any]:
        """The sizes and digests of the files, for `rewind`."""
        return {
            "lines": [lines.size for lines in self._lines()],
            "sha256": [lines.sha256 for lines in self._lines()],
            "segment": self._tail_first,
            "segment_rows": self._tail_rows(),
            "latest_snapshot": self._latest_snapshot,
        }

    def rewind(self, mark: Mapping[str, Any], env_step: int) -> None:
        """Go back to `mark` at `env_step`; a resumed training writes everything after it again.

        Of metrics that were repaired, the rows up to that step stay. Notices of an earlier resume
        stay, because they are not given again: its versions count from then on.
        """
        (self.path / layout.DIGESTS).unlink(missing_ok=True)
        resumed = self._notices.rows(mark["lines"][-1])
        digest = mark.get("sha256", [None])[0]  # missing in earlier checkpoints
        if begins_with(self._metrics.path, mark["lines"][0], digest):
            self._metrics.cut(mark["lines"][0])
        else:
            self._keep_metrics_up_to(env_step)
        for lines, size in zip(self._lines()[1:], mark["lines"][1:], strict=True):
            lines.cut(size)
        for row in resumed:
            if row.get("code", row.get("kind")) in RESUMING:
                self._append(self._notices, row)
        (self.path / layout.METRICS_TABLE).unlink(missing_ok=True)
        self._latest_snapshot = mark["latest_snapshot"]
        self._rewind_buffer(mark["segment"], mark["segment_rows"])

    def _keep_metrics_up_to(self, env_step: int) -> None:
        rows = RunReader(self.path).metrics().to_dict("records")
        text = b"".join(
            json_line({"env_step": row["env_step"], **decode.numbers(row)})
            for row in rows
            if row["env_step"] <= env_step
        )
        replace(self._metrics.path, lambda file: file.write(text), sync=True)
        self._metrics.close()
        self._metrics = JsonLines(self._metrics.path)

    def _rewind_buffer(self, segment: int, rows: int) -> None:
        """Go back to the first `rows` rows of the segment that begins with row `segment`."""
        for first in layout.numbers(self.path / layout.BUFFER, ".npz"):
            if first >= segment + rows:
                (self.path / layout.segment(first)).unlink()
        self._tail_first, self._tail = segment, {}
        if rows:
            name = layout.segment(segment)
            held = read_arrays(self.path / name)
            self._tail = {part: array[:rows] for part, array in held.items()}
            # Its later rows would overlap the next segment's.
            self.arrays(name, self._tail, sync=True)

    def sync(self) -> None:
        """Wait until the rows that a checkpoint relies on are on the disk.

        Later rows begin a new segment: one that is written anew could be lost with its old rows.
        """
        self._lock.check()
        for lines in self._lines():
            lines.sync()
        for path in self._unsynced:
            sync(path)
        sync(self.path / layout.BUFFER)
        self._unsynced.clear()
        self._end_segment()

    def check(self) -> None:
        """Raises LostError if another writer has taken over the folder."""
        self._lock.check()

    def resumed(self, config: RunConfig, command: str) -> None:
        """Add to `config.json` that the run was resumed, with which code and until which step."""
        description = read_json(self.path / layout.CONFIG)
        description["config"] = config.model_dump(mode="json")
        description.setdefault("resumes", []).append(
            {
                "at": datetime.now(UTC).isoformat(),
                "command": command,
                "versions": versions(),
                "git_commit": git_commit(),
            }
        )
        replace_json(self.path / layout.CONFIG, description, sync=True)

    def _lines(self) -> tuple[JsonLines, ...]:
        return self._metrics, self._profiles, self._notices

    def status(self, status: Status) -> None:
        """Replace `status.json`; a final state is also synced to the disk."""
        self._lock.check()
        content = asdict(status)
        replace_json(self.path / layout.STATUS, content, sync=status.state != "running")

    def metrics(self, row: Mapping[str, Any]) -> None:
        """Append a row of metrics."""
        self._append(self._metrics, row)

    def notice(self, env_step: int, code: str, message: str) -> None:
        """Append a notice."""
        row = {"env_step": env_step, "code": code, "message": message}
        self._append(self._notices, row)

    def profile(self, weights: Weights, bins: int) -> None:
        """Append the weight profile of a fit."""
        row = {
            "env_step": weights.env_step,
            "count": len(weights.weight),
            "bins": bin_means(weights.weight, bins).numpy(),
            "ess": ess(weights.weight),
            "zeros": zero_share(weights.weight),
        }
        self._append(self._profiles, row)

    def snapshot(self, weights: Weights, *, keep: bool) -> None:
        """Write the single weights and their policy; earlier ones are deleted unless kept."""
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
            for name in (layout.snapshot(previous), layout.policy(previous)):
                (self.path / name).unlink(missing_ok=True)
        if keep:
            self._latest_snapshot = None

    def rows(
        self, rows: Transitions, policy_version: NDArray, state: Mapping[str, NDArray] | None = None
    ) -> None:
        """Add rows to the replay buffer on disk, with the simulator's state if there is one."""
        if not len(rows):
            return
        new, name = decode.transition_arrays(rows, policy_version, state), self._tail_first
        if self._tail:
            new = {part: np.concatenate([self._tail[part], new[part]]) for part in new}
        self._tail = new
        self.arrays(layout.segment(name), new)
        self._unsynced.add(self.path / layout.segment(name))
        if self._tail_rows() >= SEGMENT_ROWS:
            self._end_segment()

    def arrays(self, name: str, arrays: Mapping[str, NDArray], *, sync: bool = False) -> None:
        """Write the file `name` of arrays."""
        self._lock.check()
        replace(
            self.path / name,
            lambda file: np.savez(file, allow_pickle=False, **arrays),
            sync=sync,
        )

    def metrics_table(self) -> None:
        """Write the Parquet copy of the metrics."""
        rows = self._metrics.rows()
        table = pa.Table.from_pandas(decode.metrics_table(rows), preserve_index=False)
        self._table(layout.METRICS_TABLE, table, sync=True)

    def digests(self) -> None:
        """Write the digests of a run that has finished."""
        self._lock.check()
        integrity.write_digests(self.path)

    def close(self) -> None:
        """Close the files and release the lock."""
        for lines in self._lines():
            lines.close()
        self._lock.close()

    def _tail_rows(self) -> int:
        return len(self._tail["policy_version"]) if self._tail else 0

    def _end_segment(self) -> None:
        self._tail_first += self._tail_rows()
        self._tail = {}

    def _append(self, lines: JsonLines, row: Mapping[str, Any]) -> None:
        self._lock.check()
        lines.append(row)

    def _table(self, name: str, table: pa.Table, *, sync: bool = False) -> None:
        self._lock.check()
        replace(self.path / name, lambda file: write_table(file, table, **NUMBERS), sync=sync)


def _description(run_id: str, config: RunConfig, matmul: object, command: str) -> dict[str, Any]:
    """The content of `config.json`: everything that a run was started with."""
    from tom.record.task_record import description

    task, needed = description(config.env), plugins.needed(config)
    return {
        "schema": layout.SCHEMA,
        "run_id": run_id,
        "env": config.env,
        "learner": config.learner,
        "seed": config.seed,
        "preset": config.preset,
        "config": config.model_dump(mode="json"),
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(),
        "matmul": matmul,
        "command": command,
        "created": datetime.now(UTC).isoformat(),
        **({} if task is None else {"task": task}),
        **({"plugins": needed} if needed else {}),
    }


def _prepare(path: Path) -> None:
    """Remove what a killed writer left (we hold the lock), and make folders of later versions."""
    for folder in (path, *(path / name for name in layout.FOLDERS)):
        folder.mkdir(exist_ok=True)
        for left in folder.glob(".*.tmp"):
            if not left.name.startswith(f".{layout.LABELS}"):  # labels are written by others
                left.unlink(missing_ok=True)


def _renew(path: Path) -> None:
    """Replace the growing files by copies.

    A writer on another machine may still have them open, with rows that its kernel has not sent
    yet; those rows then end in files that no longer have a name.
    """
    for name in layout.LINES:
        if (path / name).exists():
            content = (path / name).read_bytes()
            replace(path / name, lambda file, content=content: file.write(content), sync=True)
