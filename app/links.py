"""The addresses of the studio's servers, passed by the launcher to its processes."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Self
from urllib.parse import quote

from app.theme import Mode
from tom.machine.address import in_url, local_host
from tom.record.rerun import hub

VARIABLE = "TOM_STUDIO"
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class Links:
    """The store and the addresses of one studio; port 0 means that there is no such server."""

    store: str = "runs"
    host: str = "127.0.0.1"
    port: int = 0
    rerun_port: int = 0
    """the Rerun hub: the web viewer's page and the live recordings"""
    viser_port: int = 0
    control: str = ""
    """the socket through which pages control the viser server"""
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
    def local_host(self) -> str:
        """The address under which this machine reaches the host."""
        return local_host(self.host)

    @property
    def local_only(self) -> bool:
        """Whether only this machine can reach the studio."""
        return self.host in LOOPBACK

    @property
    def address(self) -> str:
        """The address of the pages."""
        return f"http://{in_url(self.local_host)}:{self.port}"

    def opened(self, path: str = "") -> str:
        """A page's address for the user, with the key if the user may act."""
        fragment = f"#key={self.key}" if self.local_only else ""
        return f"{self.address}/{path}{fragment}"

    @property
    def tunnels(self) -> str:
        """ssh's options that bring the pages and both viewers to another machine, same ports."""
        ports = (self.port, self.rerun_port, self.viser_port)
        host = in_url(self.local_host)
        return " ".join(f"-L {port}:{host}:{port}" for port in ports)

    def rerun_live(self, host: str, run_id: str, mode: Mode) -> str:
        """The web viewer's address for a live run."""
        source = hub.live_url(host, self.rerun_port, run_id)
        return hub.viewer_url(host, self.rerun_port, source, mode)

    def rerun_files(self, host: str, run_id: str, names: Sequence[str], mode: Mode) -> str:
        """The web viewer's address for a run's recordings (one more after each resume)."""
        folder = f"http://{host}:{self.port}/rrd/{quote(run_id)}"
        first, *rest = [f"{folder}/{quote(name)}" for name in names]
        more = "".join(f"&url={quote(url, safe='')}" for url in rest)
        return hub.viewer_url(host, self.rerun_port, first, mode) + more

    def rerun_episode(
        self, host: str, run_id: str, step: int, index: int, horizon: int, mode: Mode
    ) -> str:
        """The web viewer's address for one evaluation episode and its ghost."""
        file = f"http://{host}:{self.port}/rrd/{quote(run_id)}/episode-{step}-{index}-{horizon}.rrd"
        return hub.viewer_url(host, self.rerun_port, file, mode)

    def viser(self, host: str, client: str, mode: Mode) -> str:
        """The viser page for `client`, the name used on the control socket.

        The mode is in the address, because the scene server's setting would come too late.
        """
        socket = quote(f"ws://{host}:{self.viser_port}/{quote(client)}", safe="")
        dark = "&darkMode" if mode == "dark" else ""
        return f"http://{host}:{self.viser_port}/?websocket={socket}&hideViserLogo{dark}"
