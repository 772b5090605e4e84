"""A run in an object store: each attempt at it writes below a name of its own.

`<run_id>/<attempt>/...` holds a run folder. An object store has neither locks nor renames, so
nobody ever writes what somebody else writes: whoever goes on with a run copies it into a new
attempt, and an attempt that was thought dead can spoil nothing but its own. `status.json` is put
last; the newest attempt that has one is the run.
"""

import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tom.record import checkpoint, layout
from tom.record.bucket.objects import Bucket
from tom.record.files import files_in
from tom.record.lock import LostError

NAME = re.compile(r"\d{6}-[0-9a-f]{8}")
CLAIM = "claimed"  # an attempt's first object
TRIES = 3  # an object may be replaced by others while a run is fetched


def newest(names: Sequence[str]) -> str | None:
    """The attempt whose content is the run, from the names of a run's objects."""
    parts = [name.split("/") for name in names]
    whole = [part[1] for part in parts if len(part) == 3 and part[2] == layout.STATUS]
    return max((name for name in whole if NAME.fullmatch(name)), default=None)


def newest_checkpoint(names: Sequence[str]) -> int:
    """The step of the newest checkpoint of the run, from the names of its objects; -1: none."""
    start = f"/{newest(names)}/{checkpoint.FOLDER}/"
    inside = [name.partition(start)[2] for name in names if name.endswith(checkpoint.MANIFEST)]
    steps = [name.split("/")[0] for name in inside]
    return max((int(step) for step in steps if step.isdecimal()), default=-1)


def fetch(bucket: Bucket, run_id: str, target: Path) -> str | None:
    """Copy a run into the folder `target`; the attempt that it was, None where there is no run.

    Raises OSError where the store does not answer.
    """
    for last in (*[False] * (TRIES - 1), True):
        attempt = newest(bucket.names(run_id))
        if attempt is None:
            return None
        shutil.rmtree(target, ignore_errors=True)
        try:
            bucket.fetch(f"{run_id}/{attempt}", target)
        except FileNotFoundError:  # a new checkpoint has taken the place of an old one
            if last:
                raise
            continue
        (target / CLAIM).unlink(missing_ok=True)
        for folder in layout.FOLDERS:  # an object store has no empty ones
            (target / folder).mkdir(exist_ok=True)
        return attempt
    return None


@dataclass
class Attempt:
    """Puts a run folder into the store, again and again. All methods raise OSError."""

    bucket: Bucket
    run_id: str
    name: str
    _held: dict[str, tuple[int, int]] = field(default_factory=dict)
    """what the store has of each file: its time of change in ns and its size"""

    @classmethod
    def claim(cls, bucket: Bucket, run_id: str) -> "Attempt":
        """Begin a new attempt; every earlier one ends when it next looks."""
        number = int(_last(bucket, run_id).partition("-")[0]) + 1
        name = f"{number:06d}-{secrets.token_hex(4)}"
        bucket.write(f"{run_id}/{name}/{CLAIM}", name.encode())
        return cls(bucket, run_id, name)

    def check(self) -> None:
        """Raises LostError where there is a newer attempt."""
        if _last(self.bucket, self.run_id) != self.name:
            raise LostError(f"run '{self.run_id}' was taken over by another attempt")

    def put(self, folder: Path) -> None:
        """Bring the store's copy of `folder` up to date.

        Wherever this breaks off, it leaves a run that can go on: data come first, then checkpoints,
        their manifests and the status, and only then is removed what the folder has no more.
        """
        self.check()
        status = (folder / layout.STATUS).read_bytes()  # before all: `finished` speaks for the rest
        # Checkpoints before the data that they count on, which is there before them.
        found = _files(folder, folder / checkpoint.FOLDER) | _files(folder, folder)
        for name in sorted(found, key=_rank):
            if self._held.get(name) == found[name]:
                continue
            try:
                self._write(name, (folder / name).read_bytes())
            except FileNotFoundError:  # the training has dropped it since
                continue
            self._held[name] = found[name]
        self._write(layout.STATUS, status)
        gone = [name for name in self._held if name not in found]
        self.bucket.remove(self._name(name) for name in gone)
        for name in gone:
            del self._held[name]

    def supersede(self, earlier: str) -> None:
        """Remove an earlier attempt, all of which this one holds."""
        self.bucket.remove(self.bucket.names(f"{self.run_id}/{earlier}"))

    def _write(self, name: str, content: bytes) -> None:
        self.bucket.write(self._name(name), content)

    def _name(self, name: str) -> str:
        return f"{self.run_id}/{self.name}/{name}"


def _last(bucket: Bucket, run_id: str) -> str:
    """The newest attempt that was claimed."""
    return max((n for n in bucket.folders(run_id) if NAME.fullmatch(n)), default="000000")


def _files(folder: Path, part: Path) -> dict[str, tuple[int, int]]:
    """Time of change and size of every file in `part` but the status and those with a dot."""
    found: dict[str, tuple[int, int]] = {}
    for path, stat in files_in(part):
        name = path.relative_to(folder)
        if name.as_posix() != layout.STATUS and not any(one.startswith(".") for one in name.parts):
            found[name.as_posix()] = (stat.st_mtime_ns, stat.st_size)
    return found


def _rank(name: str) -> tuple[int, str]:
    if not name.startswith(f"{checkpoint.FOLDER}/"):
        return 0, name
    return (2 if name.endswith(checkpoint.MANIFEST) else 1), name
