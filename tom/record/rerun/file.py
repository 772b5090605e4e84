"""A run's whole Rerun recording as one file, made from the run folder."""

import os
import threading
from functools import partial
from pathlib import Path
from typing import BinaryIO

import rerun as rr

from tom.record.files import replace
from tom.record.reader import RunReader
from tom.record.rerun.feed import Follower

WRITTEN_S = 600.0
"""seconds in which Rerun must write the rest of a recording"""

BLOCK_BYTES = 1_000_000


def write(reader: RunReader, path: Path) -> None:
    """Write the recording. Raises OSError if it does not fit on the disk."""
    replace(path, partial(_record, reader), sync=False)


def _record(reader: RunReader, file: BinaryIO) -> None:
    """Let Rerun write into a pipe, from which the recording goes into `file`.

    On a full disk Rerun itself waits for good, or leaves the end out without a word.
    """
    out, into = os.pipe()
    pouring = Pouring(out, file)
    pouring.start()
    try:
        follower = Follower(reader, rr.FileSink(f"/dev/fd/{into}"))  # its pieces are a file each
        for _ in follower.follow():
            if pouring.error is not None:
                break
        follower.close(WRITTEN_S)
    except RuntimeError as error:  # Rerun's error for a disk that takes too long
        raise OSError(str(error)) from error
    finally:
        os.close(into)
    pouring.join()
    if pouring.error is not None:
        raise pouring.error


class Pouring(threading.Thread):
    """Writes what comes out of a pipe into `file`; after an error it goes on to empty the pipe."""

    def __init__(self, out: int, file: BinaryIO) -> None:
        """`out`: the pipe's end to read from, which is closed at the pipe's end."""
        super().__init__(name="pouring", daemon=True)
        self._out = out
        self._file = file
        self.error: OSError | None = None

    def run(self) -> None:
        with os.fdopen(self._out, "rb", buffering=0) as out:
            while block := out.read(BLOCK_BYTES):
                self._write(block)

    def _write(self, block: bytes) -> None:
        try:
            if self.error is None:
                self._file.write(block)
        except OSError as error:
            self.error = error
