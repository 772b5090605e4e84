"""Where the studio's servers are: written by the launcher, read by each of its processes."""

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
    """The store and the addresses of one studio; port 0 means that the server is not there."""

    store: str = "runs"
    host: str = "127.0.0.1"
    port: int = 0
    rerun_port: int = 0
    """the Rerun hub: the web viewer's page and what trains"""
    viser_port: int = 0
    control: str = ""
    """the socket where the pages tell the viser server what to show"""
    theme: Mode | None = None
    key: str = field(default="", repr=False)
    """whose pages may act; made anew by each launch, and without one none may"""

    @classmethod
    def from_environment(cls) -> Self:
        """The links of this process's studio; the default store and no servers without one."""
        return cls(**json.loads(os.environ.get(VARIABLE, "{}")))

    def environment(self) -> dict[str, str]:
        """The environment in which a process of this studio runs."""
        return {VARIABLE: json.dumps(asdict(self))}

    @property
    def local_host(self) -> str:
        """The host as this machine itself reaches it."""
        return local_host(self.host)

    @property
    def local_only(self) -> bool:
        """Only this machine reaches the studio."""
        return self.host in LOOPBACK

    @property
    def address(self) -> str:
        """Where the pages are."""
        return f"http://{in_url(self.local_host)}:{self.port}"

    def opened(self, path: str = "") -> str:
        """What a user opens: a page's address, with the key where its holder may act."""
        fragment = f"#key={self.key}" if self.local_only else ""
        return f"{self.address}/{path}{fragment}"

    def rerun_live(self, host: str, mode: Mode) -> str:
        """The web viewer, following what trains now."""
        source = hub.live_url(host, self.rerun_port)
        return hub.viewer_url(host, self.rerun_port, source, mode)

    def rerun_files(self, host: str, run_id: str, names: Sequence[str], mode: Mode) -> str:
        """The web viewer, showing a run's recordings (one more after each resume)."""
        folder = f"http://{host}:{self.port}/rrd/{quote(run_id)}"
        first, *rest = [f"{folder}/{quote(name)}" for name in names]
        more = "".join(f"&url={quote(url, safe='')}" for url in rest)
        return hub.viewer_url(host, self.rerun_port, first, mode) + more

    def rerun_episode(
        self, host: str, run_id: str, step: int, index: int, horizon: int, mode: Mode
    ) -> str:
        """The web viewer, showing one evaluation episode and its ghost."""
        file = f"http://{host}:{self.port}/rrd/{quote(run_id)}/episode-{step}-{index}-{horizon}.rrd"
        return hub.viewer_url(host, self.rerun_port, file, mode)

    def viser(self, host: str, client: str) -> str:
        """The viser page of the client named `client`, which the control socket speaks of."""
        socket = quote(f"ws://{host}:{self.viser_port}/{quote(client)}", safe="")
        return f"http://{host}:{self.viser_port}/?websocket={socket}&hideViserLogo"
