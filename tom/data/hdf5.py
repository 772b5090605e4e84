"""Open HDF5 files of recorded experience, with errors that tell the user what to fix.

Such a file is not trusted: it may be damaged, and may name other files of this machine as its own.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from tom import readable
from tom.data.unpack import DAMAGE
from tom.errors import UserError, reason
from tom.machine.memory import available, ran_out


@contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open the file at `path` for reading. Raises UserError if it is not HDF5."""
    if not path.is_file():
        raise UserError(f"no file {path}: give the path of an HDF5 file")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except DAMAGE as error:
        if ran_out(error):
            raise
        raise UserError(
            f"{path} is not a whole HDF5 file: fetch it again ({reason(error)})"
        ) from error


def member(group: h5py.Group, name: str) -> object:
    """A member of a group; None if there is none. Raises UserError for a link, which may lead to
    any file of this machine."""
    if name in group and not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise UserError(
            f"'{name}' in {group.file.filename}:{group.name} is a link: only data within the file "
            "is read"
        )
    return group.get(name)


def column(group: h5py.Group, name: str, axes: int) -> np.ndarray:
    """The array `name` of a group as float32; a trailing axis of length one may be dropped.

    Raises UserError if there is no such array in the file itself, or it cannot be held or read.
    """
    stored = member(group, name)
    where = f"'{name}' in {group.file.filename}:{group.name}"
    if not isinstance(stored, h5py.Dataset):
        held = ", ".join(map(str, group)) or "nothing"
        raise UserError(
            f"no array {where} (it has {held}): only data with flat observations and actions is "
            "read, under the names of docs/your-own.md"
        )
    if stored.external or stored.is_virtual:  # either could read any file on this machine
        raise UserError(f"{where} lies in another file: only data within the file is read")
    if stored.shape is not None and stored.nbytes > available():
        raise UserError(f"{where} has {readable.size(stored.nbytes)}, more than the free memory")
    values = np.asarray(stored[()])
    if axes == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != axes or values.dtype.kind not in "biuf":
        raise UserError(f"{where} is {values.dtype}{values.shape}, not numbers on {axes} axes")
    return values.astype(np.float32, copy=False)
