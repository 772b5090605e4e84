"""Rerun recordings made from run folders: live for a viewer, or one file of a whole run.

`python -m tom.record.rerun.feed STORE RUN` writes one that grows with its run to stdout. They read
run folders like any reader: trainings do not know of them, and they may start late.
"""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import rerun as rr

from tom import plugins
from tom.record import layout
from tom.record.decode import metrics_table, profiles_of
from tom.record.files import open_lines, parse_json_line, replace
from tom.record.reader import RunReader
from tom.record.rerun.view import RerunView
from tom.record.store import Store

POLL_S = 1.0
WRITTEN_S = 600.0
"""seconds in which Rerun must write the rest of a recording"""
END, END_BYTES = b"RRF2FOOT", 16
"""what stands among the last bytes of a whole recording"""
ROWS = 256  # of metrics sent together, because a viewer takes a second for some hundred chunks


class Tail:
    """The new rows of a JSON lines file since the last call."""

    def __init__(self, path: Path, offset: int = 0) -> None:
        """Begin `offset` bytes after the beginning of the file."""
        self._path = path
        self._offset = offset

    def rows(self) -> list[dict[str, Any]]:
        """New complete rows; damaged ones are left out.

        A file that became shorter is read again from the start: a resumed run writes it again.
        """
        try:
            with open_lines(self._path) as file:
                if file.seek(0, os.SEEK_END) < self._offset:
                    self._offset = 0
                file.seek(self._offset)
                text = file.read()
        except OSError:  # it does not exist yet
            return []
        whole = text[: text.rfind(b"\n") + 1]
        self._offset += len(whole)
        return [row for row in map(parse_json_line, whole.splitlines()) if row]


class Follower:
    """The state of one run's live recording."""

    def __init__(
        self,
        run: RunReader,
        sink: rr.FileSink | None = None,
        after: int = -1,
        offsets: Sequence[int] = (0, 0),
    ) -> None:
        """Begin with the evaluations of steps after `after`, and with rows at these `offsets`.

        The offsets are bytes of the metrics and of the profiles.
        """
        self.run = run
        self._view = RerunView(run, sink)
        self._metrics = Tail(run.path / layout.METRICS, offsets[0])
        self._profiles = Tail(run.path / layout.PROFILES, offsets[1])
        self._after = after

    def follow(self) -> Iterator[None]:
        """Send new data piece by piece, because a long run would be gigabytes at once."""
        rows = self._metrics.rows()
        for first in range(0, len(rows), ROWS):
            self._view.metrics(metrics_table(rows[first : first + ROWS]))
            yield
        profiles = profiles_of(self._profiles.rows())
        for step, bins in zip(profiles.env_step.tolist(), profiles.bins, strict=True):
            self._view.profile(step, bins)
            yield
        for step in self.run.evaluation_steps():
            if step > self._after:
                self._after = step
                self._view.evaluation(step)
                yield

    def pieces(self) -> Iterator[bytes]:
        """New data as bytes, none of them empty, if there is no sink."""
        for _ in self.follow():
            if piece := self._view.read():
                yield piece
        if piece := self._view.read():
            yield piece

    def close(self, within_s: float) -> None:
        """Flush the remaining data. Raises RuntimeError if this takes too long."""
        self._view.close(within_s)


def stream(run: RunReader) -> Iterator[bytes]:
    """The bytes of a recording that grows and ends with the run, as soon as there are new ones."""
    follower = Follower(run)
    while True:
        # A new reader reads it again: before the rows, so that later rows are not missed.
        alive = RunReader(run.path).status.alive
        yield from follower.pieces()
        if not alive:
            return
        time.sleep(POLL_S)


def write(reader: RunReader, path: Path) -> None:
    """Write the whole recording of a run as one file. Raises OSError if it cannot be written."""
    replace(path, lambda file: _record(reader, Path(file.name)), sync=False)


def _record(reader: RunReader, path: Path) -> None:
    follower = Follower(reader, rr.FileSink(path))
    for _ in follower.follow():
        pass
    try:
        follower.close(WRITTEN_S)
    except RuntimeError as error:  # Rerun's error for a disk that takes too long
        raise OSError(str(error)) from error
    with path.open("rb") as file:
        file.seek(-END_BYTES, os.SEEK_END)
        whole = END in file.read()
    if not whole:  # on a full disk Rerun leaves the end out without a word
        raise OSError(f"{path.parent} does not take the whole recording: is the disk full?")


def main() -> None:
    """Write the growing recording of a run of a store to stdout until the run ends."""
    plugins.load()
    store, run_id = sys.argv[1:]
    for piece in stream(Store(store).run(run_id)):
        sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
