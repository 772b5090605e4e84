"""Runs in an object store, where each attempt to train one writes under its own prefix.

`<run_id>/<attempt>/...` holds a run folder. An object store has neither locks nor renames, so two
writers never share a prefix: a process that resumes a run copies it into a new attempt, and an
attempt that was wrongly taken for dead can damage only its own objects. `status.json` is put last;
the newest attempt that has one is the run.
"""

import os
import re
import secrets
import shutil
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from pyarrow import fs

from tom.errors import UserError, reason
from tom.record import checkpoint, layout, lock, manage
from tom.record.files import files_in, temp_path
from tom.record.lock import LostError
from tom.record.reader import RunReader
from tom.record.store import Store

CONNECT_S, ANSWER_S, TRIES = 10.0, 30.0, 3
ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL")
"""the environment's variables for the store's address, the first one counts"""
URL = re.compile(r"s3://(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(?:/(?P<prefix>[^?#]*))?")

NAME = re.compile(r"\d{6}-[0-9a-f]{8}")  # of an attempt: its number and what no other one has
CLAIM = "claimed"  # an attempt's first object; removed when its process was seen to end

FETCHED, SAME, AHEAD, BUSY = "fetched", "is up to date", "is further here", "is being written here"
FETCHED_ANEW = "fetched; what was here, perhaps another run, is in the trash"


class Bucket:
    """The objects below a URL, by relative names. All methods except `open` raise OSError."""

    def __init__(self, files: fs.FileSystem, url: str) -> None:
        self._files = files
        self.url = url

    @classmethod
    def open(cls, url: str) -> "Bucket":
        """The store at `url`; credentials, region and endpoint are those of the environment.

        Raises UserError if the URL is malformed or the bucket cannot be reached.
        """
        match = URL.fullmatch(url)
        if match is None:
            raise UserError(f"{url}: must be s3://BUCKET/PREFIX, the bucket in lower-case letters")
        name, prefix = match["bucket"], (match["prefix"] or "").strip("/")
        try:
            files = _connect(name)
            kind = files.get_file_info(name).type
        except (OSError, ValueError) as error:  # pyarrow has ValueErrors of its own
            raise UserError(f"{url}: cannot reach the bucket: {reason(error)}") from error
        if kind is fs.FileType.NotFound:
            raise UserError(f"{url}: there is no bucket '{name}' (or these credentials see none)")
        below = fs.SubTreeFileSystem(f"{name}/{prefix}" if prefix else name, files)
        return cls(below, url.rstrip("/"))

    def names(self, folder: str = "") -> list[str]:
        """The names of all objects below `folder`, sorted."""
        below = fs.FileSelector(folder, allow_not_found=True, recursive=True)
        infos = self._files.get_file_info(below)
        return sorted(one.path for one in infos if one.type is fs.FileType.File)

    def folders(self, folder: str = "") -> list[str]:
        """The names of the folders directly below `folder`, sorted."""
        below = fs.FileSelector(folder, allow_not_found=True)
        infos = self._files.get_file_info(below)
        return sorted(one.base_name for one in infos if one.type is fs.FileType.Directory)

    def read(self, name: str) -> bytes:
        """The content of an object. Raises FileNotFoundError if it does not exist."""
        with self._files.open_input_stream(name) as stream:
            return stream.read()

    def write(self, name: str, content: bytes) -> None:
        """Put an object; it appears whole or not at all."""
        with self._files.open_output_stream(name) as stream:
            stream.write(content)

    def remove(self, names: Iterable[str]) -> None:
        """Delete objects; missing ones are ignored."""
        for name in names:
            with suppress(FileNotFoundError):
                self._files.delete_file(name)


def _connect(bucket: str) -> fs.S3FileSystem:
    """Connect with endpoint and time limits; pyarrow's own set-up does not support both.

    Raises UserError if the environment names a malformed endpoint.
    """
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    where: dict[str, str] = {}
    if variable := next(filter(os.environ.get, ENDPOINTS), None):
        address = urlsplit(os.environ[variable])
        if address.scheme not in ("http", "https") or not address.netloc:
            raise UserError(f"{variable}: must be an address such as http://localhost:9000")
        where = {"endpoint_override": address.netloc, "scheme": address.scheme}
    elif not region:
        region = fs.resolve_s3_region(bucket)
    return fs.S3FileSystem(
        region=region,
        connect_timeout=CONNECT_S,
        request_timeout=ANSWER_S,
        allow_delayed_open=True,  # a small object is one request
        retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=TRIES),
        **where,
    )


def newest(names: Sequence[str], file: str = layout.STATUS) -> str | None:
    """The newest attempt that has an object `file`, of the names of a run's objects.

    With a status it is the run; with CLAIM it is the newest that a process has begun.
    """
    parts = [name.split("/") for name in names]
    having = [part[1] for part in parts if len(part) == 3 and part[2] == file]
    return max((name for name in having if NAME.fullmatch(name)), default=None)


def checkpoints(names: Sequence[str]) -> list[str]:
    """The names of the run's whole checkpoints, of the names of its objects."""
    start, end = f"/{newest(names)}/{checkpoint.FOLDER}/", f"/{checkpoint.MANIFEST}"
    inside = [name.partition(start)[2] for name in names if name.endswith(end)]
    return [name.removesuffix(end) for name in inside if name.removesuffix(end).isdecimal()]


def fetch(bucket: Bucket, run_id: str, target: Path) -> str | None:
    """Copy a run into the folder `target`; returns the attempt, or None if there is no run.

    Raises OSError if the store does not answer, or an object's name leads out of `target`.
    """
    for _ in range(TRIES):
        names = bucket.names(run_id)
        attempt = newest(names)
        if attempt is None:
            return None
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        start = f"{run_id}/{attempt}/"
        with suppress(FileNotFoundError):  # a new checkpoint has replaced an old one
            for name in (name for name in names if name.startswith(start)):
                path = target / name.removeprefix(start)
                if not path.resolve().is_relative_to(target.resolve()):
                    raise OSError(f"{bucket.url}/{name} leads out of {target}: not fetched")
                if name != f"{start}{CLAIM}":
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(bucket.read(name))
            return attempt
    raise OSError(f"run '{run_id}' changes faster than it can be copied")


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
        with lock.exclusive_lock(store.path):
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
    if lock.is_held(held.path):
        return BUSY
    if held.status == fetched.status:
        return SAME
    steps = [
        max(run.status.env_step, checkpoint.newest(run.path / checkpoint.FOLDER) or 0)
        for run in (held, fetched)
    ]
    if held.status.state == "finished" or steps[0] > steps[1]:
        return AHEAD
    same_run = held.config.get("created") == fetched.config.get("created")
    with closing(lock.acquire(held.path)):
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


@dataclass
class Attempt:
    """Copies a run folder into the store repeatedly. All methods raise OSError."""

    bucket: Bucket
    run_id: str
    name: str
    _put: dict[str, tuple[int, int]] = field(default_factory=dict)
    """modification time in ns and size of each file when it was last put"""

    @classmethod
    def claim(cls, bucket: Bucket, run_id: str, own: str = "") -> "Attempt":
        """Begin a new attempt; every earlier attempt ends at its next `put`.

        Its name ends with `own`, by which its driver knows it (default: drawn).
        """
        number = int(_last(bucket, run_id).partition("-")[0]) + 1
        name = f"{number:06d}-{own or secrets.token_hex(4)}"
        bucket.write(f"{run_id}/{name}/{CLAIM}", name.encode())
        return cls(bucket, run_id, name)

    def put(self, folder: Path) -> None:
        """Bring the store's copy of `folder` up to date.

        If this is interrupted, the run can still be resumed: data is put first, then checkpoints,
        their manifests and the status; only then are deleted files removed from the store. Raises
        LostError if there is a newer attempt.
        """
        if _last(self.bucket, self.run_id) != self.name:
            raise LostError(f"run '{self.run_id}' was taken over by another attempt")
        prefix = f"{self.run_id}/{self.name}"
        status = (folder / layout.STATUS).read_bytes()  # read before all other files
        # Checkpoints are listed first: their data was written before them and is listed later.
        files: dict[str, tuple[int, int]] = {}
        for path, stat in (*files_in(folder / checkpoint.FOLDER), *files_in(folder)):
            name = path.relative_to(folder)
            if name != Path(layout.STATUS):
                files[name.as_posix()] = stat.st_mtime_ns, stat.st_size
        for name in sorted(files, key=_rank):
            if self._put.get(name) == files[name]:
                continue
            try:
                content = (folder / name).read_bytes()
            except FileNotFoundError:  # the training has deleted it since
                continue
            self.bucket.write(f"{prefix}/{name}", content)
            self._put[name] = files[name]
        self.bucket.write(f"{prefix}/{layout.STATUS}", status)
        removed = [name for name in self._put if name not in files]
        self.bucket.remove(f"{prefix}/{name}" for name in removed)
        self._put = {name: stamp for name, stamp in self._put.items() if name in files}


def _last(bucket: Bucket, run_id: str) -> str:
    return max((n for n in bucket.folders(run_id) if NAME.fullmatch(n)), default="000000")


def _rank(name: str) -> tuple[int, str]:
    if not name.startswith(f"{checkpoint.FOLDER}/"):
        return 0, name
    return (2 if name.endswith(checkpoint.MANIFEST) else 1), name
