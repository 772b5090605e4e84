"""A run's whole Rerun recording as one file, made from the run folder."""

from pathlib import Path
from typing import BinaryIO

import rerun as rr

from tom.record.files import replace
from tom.record.reader import RunReader
from tom.record.rerun.feed import Follower

WRITTEN_S = 600.0
"""seconds in which Rerun must write the rest of a recording to disk"""


def write(reader: RunReader, path: Path) -> None:
    """Write the recording. Raises OSError if it does not fit on the disk."""

    def pieces(file: BinaryIO) -> None:
        try:
            follower = Follower(reader, rr.FileSink(file.name))  # its pieces are a file each
            for _ in follower.follow():
                pass
            follower.close(WRITTEN_S)
        except RuntimeError as error:  # Rerun's error for a full disk
            raise OSError(f"{error}: is the disk full?") from error

    replace(path, pieces, sync=False)
