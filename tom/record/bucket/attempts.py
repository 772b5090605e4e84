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
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tom.errors import UserError
from tom.record import checkpoint, layout, lock, manage
from tom.record.bucket.objects import Bucket
from tom.record.files import files_in, temp_path
from tom.record.lock import LostError
from tom.record.reader import RunReader
from tom.record.store import Store

NAME = re.compile(r"\d{6}-[0-9a-f]{8}")
OWN_BYTES = 4  # of an attempt's name, which no other attempt has
CLAIM = "claimed"  # an attempt's first object; removed when its process was seen to end
TRIES = 3  # an object may be replaced by others while a run is fetched

FETCHED, SAME, AHEAD, BUSY = "fetched", "is up to date", "is further here", "is being written here"
FETCHED_ANEW = "fetched; what was here, perhaps another run, is in the trash"


def run_ids(bucket: Bucket) -> list[str]:
    """The ids of the runs in the object store. Raises OSError if it does not answer."""
    return [name for name in bucket.folders() if layout.RUN_ID.fullmatch(name)]


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


def fetch_run(bucket: Bucket, run_id: str, store: Store) -> str:
    """Bring the store's copy of a run up to date; returns what was done.

    Local labels are kept, and so is a local run that is further. Raises UserError if there is no
    such run, OSError if the object store does not answer.
    """
    place = store.resolve(run_id)
    unfinished = temp_path(place)
    try:
        if fetch(bucket, run_id, unfinished) is None:
            raise UserError(f"no run '{run_id}' in {bucket.url}")
        with lock.alone_in(store.path):
            if place.exists():
                return _replace(store, RunReader(place), RunReader(unfinished))
            unfinished.rename(place)
            return FETCHED
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _replace(store: Store, held: RunReader, fetched: RunReader) -> str:
    """Replace the store's run by the fetched one if that is further.

    An older copy of it is deleted. Another run of that name goes to the trash, and so does a run
    of which nobody can tell how far it got.
    """
    if lock.held(held.path):
        return BUSY
    if held.status == fetched.status:
        return SAME
    if held.status.state == "finished" or _reached(held) > _reached(fetched):
        return AHEAD
    same_run = held.config.get("created") == fetched.config.get("created")
    with manage.unwritten(held):
        if same_run and (held.path / layout.LABELS).is_file():
            shutil.copy2(held.path / layout.LABELS, fetched.path / layout.LABELS)
        older = manage.into_trash(store, held.path)  # where it is found if this process is killed
        fetched.path.rename(held.path)
    if not same_run or held.status.state == "unknown":
        return FETCHED_ANEW
    shutil.rmtree(older)
    with suppress(OSError):  # there are other runs in the trash
        older.parent.rmdir()
    return FETCHED


def _reached(run: RunReader) -> int:
    """How far the run got; its status may be damaged, and then its checkpoints tell."""
    return max(run.status.env_step, checkpoint.newest(run.path / checkpoint.FOLDER) or 0)


@dataclass
class Attempt:
    """Copies a run folder into the store repeatedly. All methods raise OSError."""

    bucket: Bucket
    run_id: str
    name: str
    _put: dict[str, tuple[int, int]] = field(default_factory=dict)
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
            if self._put.get(name) == files[name]:
                continue
            try:
                content = (folder / name).read_bytes()
            except FileNotFoundError:  # the training has deleted it since
                continue
            self.bucket.write(self._name(name), content)
            self._put[name] = files[name]
        self.bucket.write(self._name(layout.STATUS), status)
        gone = [name for name in self._put if name not in files]
        self.bucket.remove(self._name(name) for name in gone)
        for name in gone:
            del self._put[name]

    def supersede(self, earlier: str) -> None:
        """Remove an earlier attempt; this one holds all of its content."""
        self.bucket.remove(self.bucket.names(f"{self.run_id}/{earlier}"))

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
    found = {path.relative_to(folder): stat for path, stat in files_in(part)}
    return {
        name.as_posix(): (stat.st_mtime_ns, stat.st_size)
        for name, stat in found.items()
        if name != Path(layout.STATUS) and not any(one.startswith(".") for one in name.parts)
    }


def _rank(name: str) -> tuple[int, str]:
    if not name.startswith(f"{checkpoint.FOLDER}/"):
        return 0, name
    return (2 if name.endswith(checkpoint.MANIFEST) else 1), name
