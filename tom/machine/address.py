"""Host names of local servers, and checks of a request's headers."""

import socket
from collections.abc import Callable, Collection
from urllib.parse import urlsplit

Header = Callable[[str], str | None]
"""maps a header's name to its value in a request"""
WILDCARDS = ("0.0.0.0", "::", "")
"""hosts that mean every address of this machine"""


def local_host(host: str) -> str:
    """The address under which this machine reaches a server bound to `host`."""
    return "127.0.0.1" if host in WILDCARDS else host


def names(host: str) -> list[str]:
    """The names that a browser may use for a host; an empty list means any name."""
    return [] if host in WILDCARDS else [host.lower(), "localhost", "127.0.0.1"]


def own_host(header: str, host: str, port: int) -> bool:
    """Whether a request's Host header is one of the names of the server on `host`:`port`.

    Otherwise a page under another name of this address could read the server's content.
    """
    own = [_with_port(name, port) for name in names(host)]
    return header.lower() in own if own else bool(header)


def own_origin(origin: str, header: str, ports: Collection[int]) -> bool:
    """Whether a request's Origin has the same host as its Host header and one of `ports`.

    Scheme, name and port must match, because others may serve pages on this machine.
    """
    try:
        name = urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return False
    return origin.lower() in [f"http://{_with_port(name, port)}" for port in ports]


def refusal(header: Header, host: str, port: int, pages: Collection[int] = ()) -> str | None:
    """Why the server on `host`:`port` refuses a request; None if it answers.

    It answers requests to its own names, from its own pages and from those on the other ports
    `pages`; only these may open a socket. Programs other than browsers can set any header.
    """
    asked, origin = header("Host") or "", header("Origin")
    if not own_host(asked, host, port):
        return "this address is served under its own name and port only"
    if origin is None:
        foreign = _embedded_elsewhere(header) or (header("Upgrade") or "").lower() == "websocket"
    else:
        foreign = not own_origin(origin, asked, (port, *pages))
    return "this address answers its own pages only" if foreign else None


def framing(host: str, port: int) -> str:
    """The Content-Security-Policy that lets only pages on `host`:`port` embed a page."""
    # A policy cannot name an IPv6 address, and a wildcard host has any name: check only the port.
    named = [f"http://{_with_port(name, port)}" for name in dict.fromkeys(names(host))]
    known = named and ":" not in host
    return f"frame-ancestors {' '.join(named) if known else f'http://*:{port}'}"


def _embedded_elsewhere(header: Header) -> bool:
    """Whether a page of another origin loads this as a resource, such as an image or a script."""
    elsewhere = header("Sec-Fetch-Site") in ("same-site", "cross-site")
    return elsewhere and header("Sec-Fetch-Mode") != "navigate"


def _with_port(name: str, port: int) -> str:
    """A host and port as browsers write them: without the default port."""
    return in_url(name) if port == 80 else f"{in_url(name)}:{port}"


def in_url(host: str) -> str:
    """A host as written in a URL: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def family(host: str) -> socket.AddressFamily:
    """IPv4 or IPv6."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def free_port(host: str) -> int:
    """A free port of `host`."""
    with socket.socket(family(host)) as probe:
        probe.bind((host, 0))
        return probe.getsockname()[1]
