"""An object store as files below `s3://bucket/prefix`."""

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from pyarrow import fs

from tom.errors import UserError, reason

CONNECT_S, ANSWER_S, TRIES = 10.0, 30.0, 3
ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL")
"""the environment's variables for the store's address, the first one counts"""
URL = re.compile(r"s3://(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(?:/(?P<prefix>[^?#]*))?")


class Bucket:
    """The objects below a URL, by relative names. All methods except `open` raise OSError."""

    def __init__(self, files: fs.FileSystem, base: str, url: str) -> None:
        self._files = files
        self._base = base
        self.url = url

    @classmethod
    def open(cls, url: str) -> "Bucket":
        """The store at `url`; credentials, region and endpoint are those of the environment.

        Raises UserError if the URL is malformed or the bucket cannot be reached.
        """
        match = URL.fullmatch(url)
        if match is None:
            raise UserError(f"{url}: must be s3://BUCKET/PREFIX, the bucket in lower-case letters")
        name = match["bucket"]
        prefix = (match["prefix"] or "").strip("/")
        try:
            files = _connect(name)
            kind = files.get_file_info(name).type
        except (OSError, ValueError) as error:  # pyarrow has ValueErrors of its own
            raise UserError(f"{url}: cannot reach the bucket: {reason(error)}") from error
        if kind is fs.FileType.NotFound:
            raise UserError(f"{url}: there is no bucket '{name}' (or these credentials see none)")
        return cls(files, f"{name}/{prefix}" if prefix else name, url.rstrip("/"))

    def names(self, folder: str = "") -> list[str]:
        """The names of all objects below `folder`, sorted."""
        below = fs.FileSelector(self._path(folder), allow_not_found=True, recursive=True)
        infos = self._files.get_file_info(below)
        start = len(self._base) + 1
        return sorted(one.path[start:] for one in infos if one.type is fs.FileType.File)

    def folders(self, folder: str = "") -> list[str]:
        """The names of the folders directly below `folder`, sorted."""
        below = fs.FileSelector(self._path(folder), allow_not_found=True)
        infos = self._files.get_file_info(below)
        return sorted(one.base_name for one in infos if one.type is fs.FileType.Directory)

    def read(self, name: str) -> bytes:
        """The content of an object. Raises FileNotFoundError if it does not exist."""
        with self._files.open_input_stream(self._path(name)) as stream:
            return stream.read()

    def write(self, name: str, content: bytes) -> None:
        """Put an object; it appears whole or not at all."""
        with self._files.open_output_stream(self._path(name)) as stream:
            stream.write(content)

    def remove(self, names: Iterable[str]) -> None:
        """Delete objects; missing ones are ignored."""
        for name in names:
            with suppress(FileNotFoundError):
                self._files.delete_file(self._path(name))

    def fetch(self, folder: str, target: Path) -> None:
        """Copy every object below `folder` into the folder `target`.

        Raises OSError if the store does not answer, or an object's name leads out of `target`.
        """
        for name in self.names(folder):
            path = target / name.removeprefix(f"{folder}/")
            if not path.resolve().is_relative_to(target.resolve()):
                raise OSError(f"{self.url}/{name} leads out of {target}: not fetched")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(self.read(name))

    def _path(self, name: str) -> str:
        return f"{self._base}/{name}" if name else self._base


def _connect(bucket: str) -> fs.S3FileSystem:
    """Connect with endpoint and time limits; pyarrow's own set-up does not support both."""
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    where = _endpoint()
    if not where and not region:
        region = fs.resolve_s3_region(bucket)
    return fs.S3FileSystem(
        region=region,
        connect_timeout=CONNECT_S,
        request_timeout=ANSWER_S,
        allow_delayed_open=True,  # a small object is one request
        retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=TRIES),
        **where,
    )


def _endpoint() -> dict[str, str]:
    """The endpoint that the environment names, as pyarrow takes it; empty if it names none.

    Raises UserError if it is malformed.
    """
    variable = next(filter(os.environ.get, ENDPOINTS), None)
    if variable is None:
        return {}
    address = urlsplit(os.environ[variable])
    if address.scheme not in ("http", "https") or not address.netloc:
        raise UserError(f"{variable}: must be an address such as http://localhost:9000")
    return {"endpoint_override": address.netloc, "scheme": address.scheme}
