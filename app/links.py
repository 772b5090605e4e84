"""The store and the addresses of one studio, passed by the launcher to its processes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Self
from urllib.parse import quote, urlencode

from tom.machine.address import in_url, local_host

if TYPE_CHECKING:  # the launcher does without the colours, and what they import
    from app.theme import Mode

VARIABLE = "TOM_STUDIO"
LOOPBACK = ("127.0.0.1", "localhost", "::1")
LIVE = "live.rrd"
"""the recording that grows with its run"""


@dataclass(frozen=True)
class Links:
    """The store and the addresses of one studio; without `folder` no server runs."""

    store: str = "runs"
    host: str = "127.0.0.1"
    port: int = 0
    base: str = ""
    """the path of the pages behind a proxy, such as `/user/x/studio/`; empty without a proxy"""
    folder: str = ""
    """of this launch, for its user only: sockets, logs, the viewer's files"""
    theme: Mode | None = None
    key: str = field(default="", repr=False)
    """a browser with this key may act; new at each launch; if empty, none may"""

    @classmethod
    def from_environment(cls) -> Self:
        """The links of this process's studio; without one, the default store and no servers."""
        return cls(**json.loads(os.environ.get(VARIABLE, "{}")))

    def environment(self) -> dict[str, str]:
        """The environment variables of this studio's processes."""
        return {VARIABLE: json.dumps(asdict(self))}

    @property
    def launch(self) -> str:
        """The name of this launch, for everybody: the key cannot be found from it."""
        return hashlib.sha256(self.key.encode()).hexdigest()

    @property
    def local_only(self) -> bool:
        """Whether only this machine can reach the studio."""
        return self.host in LOOPBACK

    def file(self, name: str) -> Path:
        """A file of this launch, such as the sockets of the 3D server, `control` and `scenes`."""
        return Path(self.folder, name)

    @property
    def root(self) -> str:
        """The address of this machine's studio, without a path."""
        return f"http://{in_url(local_host(self.host))}:{self.port}"

    @property
    def address(self) -> str:
        """The address of the pages."""
        return f"{self.root}{self.base.rstrip('/')}"

    def user_address(self, path: str = "") -> str:
        """A page's address for the user, with the key if the user may act."""
        fragment = f"#key={self.key}" if self.local_only else ""
        return f"{self.address}/{path}{fragment}"

    def rerun(self, run_id: str, names: Sequence[str], mode: Mode) -> str:
        """The web viewer's path for recordings of a run (one more after each resume)."""
        urls = [("url", f"../rrd/{quote(run_id)}/{quote(name)}") for name in names]
        query = urlencode([*urls, ("persist", "false"), ("notebook", "false"), ("theme", mode)])
        return f"{self.base or '/'}rerun/?{query}&hide_welcome_screen"

    def viser(self, client: str, mode: Mode) -> str:
        """The path of the viser page for `client`, the name used on the control socket.

        The mode is in the address, because the scene server's setting would come too late.
        """
        dark = "&darkMode" if mode == "dark" else ""
        return f"{self.base or '/'}viser/{quote(client)}/?hideViserLogo{dark}"
