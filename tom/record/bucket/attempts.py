"""A run in an object store, where each attempt to train it writes under its own prefix.

`<run_id>/<attempt>/...` holds a run folder. An object store has neither locks nor renames, so two
writers never share a prefix: a process that resumes a run copies it into a new attempt, and an
attempt that was wrongly taken for dead can damage only its own objects. `status.json` is put last;
the newest attempt that has one is the run.
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
OWN_BYTES = 4  # of an attempt's name, which no other attempt has
CLAIM = "claimed"  # an attempt's first object; removed when its process was seen to end
TRIES = 3  # an object may be replaced by others while a run is fetched


def newest(names: Sequence[str]) -> str | None:
    """The attempt whose content is the run, from the names of a run's objects."""
    return _newest_with(layout.STATUS, names)


def claimed(names: Sequence[str]) -> str | None:
    """The newest attempt that a process has claimed, from the names of a run's objects."""
    return _newest_with(CLAIM, names)


def release(bucket: Bucket, run_id: str, own: str) -> None:
    """Take back the claim of the attempt whose name ends with `own`, if there is one.

    Raises OSError if the store does not answer.
    """
    bucket.remove(n for n in bucket.names(run_id) if n.endswith(f"-{own}/{CLAIM}"))


def newest_checkpoint(names: Sequence[str]) -> int:
    """The step of the newest checkpoint of the run, from the names of its objects; -1: none."""
    start = f"/{newest(names)}/{checkpoint.FOLDER}/"
    inside = [name.partition(start)[2] for name in names if name.endswith(checkpoint.MANIFEST)]
    steps = [name.split("/")[0] for name in inside]
    return max((int(step) for step in steps if step.isdecimal()), default=-1)


def fetch(bucket: Bucket, run_id: str, target: Path) -> str | None:
    """Copy a run into the folder `target`; returns the attempt, or None if there is no run.

    Raises OSError if the store does not answer.
    """
    for last in (*[False] * (TRIES - 1), True):
        attempt = newest(bucket.names(run_id))
        if attempt is None:
            return None
        shutil.rmtree(target, ignore_errors=True)
        try:
            bucket.fetch(f"{run_id}/{attempt}", target)
        except FileNotFoundError:  # a new checkpoint has replaced an old one
            if last:
                raise
            continue
        (target / CLAIM).unlink(missing_ok=True)
        for folder in layout.FOLDERS:  # an object store has no empty folders
            (target / folder).mkdir(exist_ok=True)
        return attempt
    return None


@dataclass
class Attempt:
    """Copies a run folder into the store repeatedly. All methods raise OSError."""

    bucket: Bucket
    run_id: str
    name: str
    _held: dict[str, tuple[int, int]] = field(default_factory=dict)
    """modification time in ns and size of each file when it was last put"""

    @classmethod
    def claim(cls, bucket: Bucket, run_id: str, own: str | None = None) -> "Attempt":
        """Begin a new attempt; every earlier attempt ends at its next `check`.

        Its name ends with `own`, by which its driver knows it (default: drawn).
        """
        number = int(_last(bucket, run_id).partition("-")[0]) + 1
        name = f"{number:06d}-{own or secrets.token_hex(OWN_BYTES)}"
        bucket.write(f"{run_id}/{name}/{CLAIM}", name.encode())
        return cls(bucket, run_id, name)

    def check(self) -> None:
        """Raises LostError if there is a newer attempt."""
        if _last(self.bucket, self.run_id) != self.name:
            raise LostError(f"run '{self.run_id}' was taken over by another attempt")

    def put(self, folder: Path) -> None:
        """Bring the store's copy of `folder` up to date.

        If this is interrupted, the run can still be resumed: data is put first, then checkpoints,
        their manifests and the status; only then are deleted files removed from the store.
        """
        self.check()
        status = (folder / layout.STATUS).read_bytes()  # read before all other files
        # Checkpoints are listed first: their data was written before them and is listed later.
        files = _files(folder, folder / checkpoint.FOLDER) | _files(folder, folder)
        for name in sorted(files, key=_rank):
            if self._held.get(name) == files[name]:
                continue
            try:
                self._write(name, (folder / name).read_bytes())
            except FileNotFoundError:  # the training has deleted it since
                continue
            self._held[name] = files[name]
        self._write(layout.STATUS, status)
        gone = [name for name in self._held if name not in files]
        self.bucket.remove(self._name(name) for name in gone)
        for name in gone:
            del self._held[name]

    def supersede(self, earlier: str) -> None:
        """Remove an earlier attempt; this one holds all of its content."""
        self.bucket.remove(self.bucket.names(f"{self.run_id}/{earlier}"))

    def _write(self, name: str, content: bytes) -> None:
        self.bucket.write(self._name(name), content)

    def _name(self, name: str) -> str:
        return f"{self.run_id}/{self.name}/{name}"


def _newest_with(file: str, names: Sequence[str]) -> str | None:
    """The newest attempt that has an object `file`."""
    parts = [name.split("/") for name in names]
    having = [part[1] for part in parts if len(part) == 3 and part[2] == file]
    return max((name for name in having if NAME.fullmatch(name)), default=None)


def _last(bucket: Bucket, run_id: str) -> str:
    """The newest claimed attempt."""
    return max((n for n in bucket.folders(run_id) if NAME.fullmatch(n)), default="000000")


def _files(folder: Path, part: Path) -> dict[str, tuple[int, int]]:
    """Modification time and size of every file in `part` except the status and hidden files."""
    stamps: dict[str, tuple[int, int]] = {}
    for path, stat in files_in(part):
        name = path.relative_to(folder)
        if name.as_posix() != layout.STATUS and not any(one.startswith(".") for one in name.parts):
            stamps[name.as_posix()] = (stat.st_mtime_ns, stat.st_size)
    return stamps


def _rank(name: str) -> tuple[int, str]:
    if not name.startswith(f"{checkpoint.FOLDER}/"):
        return 0, name
    return (2 if name.endswith(checkpoint.MANIFEST) else 1), name
