"""Atomic writes of files and folders, and append-only JSON lines, safe also after a kill."""

import errno
import gzip
import json
import math
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from tom.record import layout

MISSING = (0, 0)
"""the stamp of a file that is missing"""


def temp_path(path: Path) -> Path:
    """A new name for what will be renamed to `path`.

    It is random, because threads share a process id, and so may two containers.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def replace(path: Path, write: Callable[[BinaryIO], object], *, sync: bool) -> None:
    """Replace `path` atomically: a reader sees the old file or the new one, never a part.

    With `sync` the file survives a power loss, at the price of waiting for the disk. A failed write
    leaves the old file and nothing else.
    """
    temporary = temp_path(path)
    try:
        with temporary.open("wb") as file:
            write(file)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A temporary folder that is renamed to `path` at the end of the block.

    After an error nothing of it remains. Raises OSError if it cannot be made, or if `path` has
    content already: of two writers one wins. What a killed process left is in nobody's way.
    """
    unfinished = temp_path(path)
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        unfinished.rename(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def replace_json(path: Path, content: Mapping[str, Any], *, sync: bool) -> None:
    """Replace `path` by `content` as JSON; numbers that are not finite become null."""
    text = json.dumps(plain(content), allow_nan=False, indent=1) + "\n"
    replace(path, lambda file: file.write(text.encode()), sync=sync)


def plain(value: Any) -> Any:
    """`value` in JSON's types: numpy values are converted, NaN and infinities become None."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


class JsonLines:
    """An append-only file of JSON objects; a row is a single write, so a kill leaves no part."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("a+b", buffering=0)

    def append(self, row: Mapping[str, Any]) -> None:
        """Append one row.

        Raises OSError if the disk is full; a partly written row is cut off again, so that the next
        row starts a new line.
        """
        line, size = json_line(row), self.size
        try:
            written = self._file.write(line)
        except OSError as error:
            raise OSError(error.errno, f"cannot write {self.path}: {error.strerror}") from error
        if written != len(line):
            self._file.truncate(size)
            raise OSError(errno.ENOSPC, f"cannot write {self.path}: is the disk full?")

    @property
    def size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def cut(self, size: int) -> None:
        """Truncate the file to `size` bytes, and to whole rows."""
        content = os.pread(self._file.fileno(), min(size, self.size), 0)
        self._file.truncate(content.rfind(b"\n") + 1)

    def sync(self) -> None:
        """Wait until the rows are on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def json_line(row: Mapping[str, Any]) -> bytes:
    """A row as a line of JSON; numbers that are not finite become null."""
    return (json.dumps(plain(row), allow_nan=False, separators=(",", ":")) + "\n").encode()


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's entries, are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def files_in(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Every file under `folder` but links and hidden ones, as the lock and unfinished files are.

    Files that vanish meanwhile are skipped.
    """
    for base, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(base, name) for name in names if not name.startswith(".")):
            try:
                entry = path.lstat()
            except OSError:
                continue
            if stat.S_ISREG(entry.st_mode):
                yield path, entry


def size_of(path: Path) -> int:
    """Bytes of a file, or of the files under a folder; 0 if it does not exist."""
    if path.is_file():
        return path.stat().st_size
    return sum(stat.st_size for _, stat in files_in(path))


def stamp(path: Path | str) -> tuple[int, int]:
    """The modification time of a file in ns of unix time, and its size.

    MISSING if it does not exist, or is in a folder that may not be looked into.
    """
    try:
        file = os.stat(path)  # noqa: PTH116 - pathlib takes longer to make a path of a text
    except OSError:
        return MISSING
    return (file.st_mtime_ns, file.st_size)


def modified(path: Path) -> int:
    """The modification time of `path` in ns of unix time; 0 if it does not exist."""
    return stamp(path)[0]


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`. Raises OSError, or ValueError if it is something else."""
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    return content


def open_lines(path: Path) -> BufferedIOBase:
    """Open a file of JSON lines, or the compressed one in its place."""
    packed = path.with_name(path.name + layout.PACKED)
    return gzip.open(packed) if packed.exists() else path.open("rb")


def read_json_lines(path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The rows of a JSON lines file, and the errors of the skipped lines."""
    with open_lines(path) as file:
        lines = file.read().split(b"\n")
    rows: list[dict[str, Any]] = []
    problems: list[str] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():  # blank in place of a damaged line (`integrity.repair`)
            continue
        if number == len(lines):
            problems.append(f"{path.name}: the last line is half written and was skipped")
            continue
        row = parse_json_line(line)
        if row is None:
            problems.append(f"{path.name}: line {number} is damaged and was skipped")
        else:
            rows.append(row)
    return rows, problems


def parse_json_line(line: bytes) -> dict[str, Any] | None:
    """The JSON object in a line; None if it is anything else."""
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) else None


def free_name(folder: Path, name: str) -> str:
    """`name`, with a number if that name is taken in the folder."""
    free, number = name, 1
    while os.path.lexists(folder / free):
        number += 1
        free = f"{name}-{number}"
    return free


def set_aside(run: Path, path: Path, *, copy: bool = False) -> Path:
    """Move a file or folder of the run folder `run` into its `damaged/`; returns the new place.

    With `copy` the file stays where it is: it is replaced next, for which the disk may be too full.
    """
    folder = (run / layout.DAMAGED / path.relative_to(run)).parent
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / free_name(folder, path.name)
    if copy:
        shutil.copyfile(path, place)
    else:
        path.rename(place)
    return place
