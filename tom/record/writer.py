"""Writes a run folder (docs/run-folder.md): files only, no threads."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.config import RunConfig
from tom.data.sampling import bin_means, ess, zero_share
from tom.data.transitions import Transitions
from tom.data.unpack import read_arrays
from tom.events import Episode, Weights
from tom.record import decode, digests, layout, lock
from tom.record.creating import make_folder
from tom.record.decode import NUMBERS, write_table
from tom.record.files import (
    JsonLines,
    begins_with,
    read_json,
    read_json_lines,
    replace,
    replace_json,
    sync,
)
from tom.record.reader import RunReader
from tom.record.status import Status
from tom.record.store import Store
from tom.record.versions import git_commit, versions

SEGMENT_ROWS = 4096
"""rows up to which a segment of the replay buffer is rewritten when new rows come"""

RESUMING = ("versions", "settings", "checkpoint")
"""the kinds of notice that a resume begins with"""


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
        _drop_unfinished(path)
        _make_folders(path)
        if taken_over:
            _renew(path)
        self._metrics = JsonLines(path / layout.METRICS)
        self._profiles = JsonLines(path / layout.PROFILES)
        self._notices = JsonLines(path / layout.NOTICES)
        self._latest_snapshot: int | None = None
        self._tail: list[dict[str, NDArray]] = []
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
        """The writer of a new run. Raises the errors of `make_folder`."""
        return cls(make_folder(store, run_id, config, matmul, command), config)

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

        Of metrics that were repaired, the rows up to that step stay, wherever they lie. What an
        earlier resume said stays: it is not said again, as its versions count from then on.
        """
        digests.forget(self.path)
        said = [row for row in self._notices.rows(mark["lines"][-1]) if row.get("kind") in RESUMING]
        digest = mark.get("sha256", [None])[0]  # missing in earlier checkpoints
        if begins_with(self._metrics.path, mark["lines"][0], digest):
            self._metrics.cut(mark["lines"][0])
        else:
            rows = RunReader(self.path).metrics().to_dict("records")
            kept = [row for row in rows if row["env_step"] <= env_step]
            self._metrics.rewrite(
                {"env_step": row["env_step"], **decode.numbers(row)} for row in kept
            )
        for lines, size in zip(self._lines()[1:], mark["lines"][1:], strict=True):
            lines.cut(size)
        for row in said:
            self._append(self._notices, row)
        (self.path / layout.METRICS_TABLE).unlink(missing_ok=True)
        self._latest_snapshot = mark["latest_snapshot"]
        self._tail_first, self._tail = mark["segment"], []
        for first in layout.numbers(self.path / layout.BUFFER, ".npz"):
            if first >= mark["segment"] + mark["segment_rows"]:
                (self.path / layout.segment(first)).unlink()
        if mark["segment_rows"]:
            name = layout.segment(self._tail_first)
            held = read_arrays(self.path / name)
            self._tail = [{of: held[of][: mark["segment_rows"]] for of in held}]
            # Its later rows would overlap the next segment's.
            self._arrays(name, self._tail[0], sync=True)

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

    def notice(self, env_step: int, kind: str, message: str) -> None:
        """Append a notice."""
        row = {"env_step": env_step, "kind": kind, "message": message}
        self._append(self._notices, row)

    def profile(self, weights: Weights, bins: int) -> NDArray[np.float64]:
        """Append the weight profile of a fit and return it, (bins,)."""
        means = bin_means(weights.weight, bins).numpy()
        row = {
            "env_step": weights.env_step,
            "count": len(weights.weight),
            "bins": means,
            "ess": ess(weights.weight),
            "zeros": zero_share(weights.weight),
        }
        self._append(self._profiles, row)
        return means

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
            self.kept_policy(weights.env_step, weights.policy)
        previous, self._latest_snapshot = self._latest_snapshot, weights.env_step
        if previous is not None and previous != weights.env_step:
            for name in (layout.snapshot(previous), layout.policy(previous)):
                (self.path / name).unlink(missing_ok=True)
        if keep:
            self._latest_snapshot = None

    def episodes(self, env_step: int, episodes: Sequence[Episode]) -> None:
        """Write the evaluation episodes at `env_step`."""
        self._arrays(layout.episodes(env_step), decode.episode_arrays(episodes))

    def rows(
        self, rows: Transitions, policy_version: NDArray, state: Mapping[str, NDArray] | None = None
    ) -> None:
        """Add rows to the replay buffer on disk, with the simulator's state if there is one."""
        if not len(rows):
            return
        self._tail.append(decode.transition_arrays(rows, policy_version, state))
        joined = {n: np.concatenate([part[n] for part in self._tail]) for n in self._tail[0]}
        self._arrays(layout.segment(self._tail_first), joined)
        self._unsynced.add(self.path / layout.segment(self._tail_first))
        self._tail = [joined]
        if self._tail_rows() >= SEGMENT_ROWS:
            self._end_segment()

    def kept_policy(self, env_step: int, arrays: Mapping[str, NDArray]) -> None:
        """Write the policy at `env_step`."""
        self._arrays(layout.policy(env_step), arrays)

    def policy(self, arrays: Mapping[str, NDArray]) -> None:
        """Write the final policy."""
        self._arrays(layout.POLICY, arrays)

    def field(self, name: str, env_step: int, arrays: Mapping[str, NDArray]) -> None:
        """Write the arrays of a task's own picture."""
        self._arrays(layout.field(name, env_step), arrays)

    def metrics_table(self) -> None:
        """Write the Parquet copy of the metrics."""
        self._lock.check()
        for lines in self._lines():
            lines.keep_name()
        rows, _ = read_json_lines(self.path / layout.METRICS)
        table = pa.Table.from_pandas(decode.metrics_table(rows), preserve_index=False)
        self._table(layout.METRICS_TABLE, table, sync=True)

    def digests(self) -> None:
        """Write the digests of a run that has finished."""
        self._lock.check()
        digests.write(self.path)

    def close(self) -> None:
        """Close the files and release the lock."""
        for lines in self._lines():
            lines.close()
        self._lock.close()

    def _tail_rows(self) -> int:
        return sum(len(part["policy_version"]) for part in self._tail)

    def _end_segment(self) -> None:
        self._tail, self._tail_first = [], self._tail_first + self._tail_rows()

    def _append(self, lines: JsonLines, row: Mapping[str, Any]) -> None:
        self._lock.check()
        lines.append(row)

    def _arrays(self, name: str, arrays: Mapping[str, NDArray], *, sync: bool = False) -> None:
        def write(file: BinaryIO) -> None:
            np.savez(file, allow_pickle=False, **arrays)

        self._lock.check()
        replace(self.path / name, write, sync=sync)

    def _table(self, name: str, table: pa.Table, *, sync: bool = False) -> None:
        def write(file: BinaryIO) -> None:
            write_table(file, table, **NUMBERS)

        self._lock.check()
        replace(self.path / name, write, sync=sync)


def _drop_unfinished(path: Path) -> None:
    """Remove the temporary files of a killed writer (we hold the lock)."""
    for folder in (path, *(path / name for name in layout.FOLDERS)):
        for temporary in folder.glob(".*.tmp"):
            if not temporary.name.startswith(f".{layout.LABELS}"):  # labels are written by others
                temporary.unlink(missing_ok=True)


def _make_folders(path: Path) -> None:
    """Make folders that an earlier version did not make."""
    for name in layout.FOLDERS:
        (path / name).mkdir(exist_ok=True)


def _renew(path: Path) -> None:
    """Replace the growing files by copies.

    A writer on another machine may still have them open, with rows that its kernel has not sent
    yet; those rows then end in files that no longer have a name.
    """
    for name in (layout.METRICS, layout.PROFILES, layout.NOTICES):
        held = path / name
        if held.exists():
            replace(held, lambda file, held=held: file.write(held.read_bytes()), sync=True)
