"""Hosts that a server is bound to: how this machine reaches them, and under which names."""

import socket
from collections.abc import Callable, Collection
from urllib.parse import urlsplit

Header = Callable[[str], str | None]
"""a request's header by its name"""
WILDCARDS = ("0.0.0.0", "::", "")
"""every address of this machine"""


def local_host(host: str) -> str:
    """A host that a server is bound to, as this machine itself reaches it."""
    return "127.0.0.1" if host in WILDCARDS else host


def names(host: str) -> list[str]:
    """The names that a browser may use for a host; empty means any."""
    return [] if host in WILDCARDS else [host.lower(), "localhost", "127.0.0.1"]


def own_host(header: str, host: str, port: int) -> bool:
    """A request's Host header names the server on `host`:`port`, by a name that it goes by.

    A page on another name for this address could otherwise read what is served here.
    """
    own = [_with_port(name, port) for name in names(host)]
    return header.lower() in own if own else bool(header)


def own_origin(origin: str, header: str, ports: Collection[int]) -> bool:
    """A request's Origin is a page of the host that its Host header asks, on one of `ports`.

    Scheme, name and port count: a page that anybody else serves on this machine is no page of ours.
    """
    try:
        name = urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return False
    return origin.lower() in [f"http://{_with_port(name, port)}" for port in ports]


def refusal(header: Header, host: str, port: int, pages: Collection[int] = ()) -> str | None:
    """Why the server on `host`:`port` does not answer a request; None where it does.

    It answers under its own names, its own pages and those on the other ports `pages`, and it
    opens a socket to them alone. A program that is no browser may say what it likes.
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
    """The Content-Security-Policy by which only the pages on `host`:`port` may show a page."""
    # A policy can name no IPv6 address, a wildcard goes by any name: there the port alone counts.
    named = [f"http://{_with_port(name, port)}" for name in dict.fromkeys(names(host))]
    known = named and ":" not in host
    return f"frame-ancestors {' '.join(named) if known else f'http://*:{port}'}"


def _embedded_elsewhere(header: Header) -> bool:
    """A page of another origin loads this as a part of itself, such as a picture or a script."""
    elsewhere = header("Sec-Fetch-Site") in ("same-site", "cross-site")
    return elsewhere and header("Sec-Fetch-Mode") != "navigate"


def _with_port(name: str, port: int) -> str:
    """A host and port as browsers write them: they leave the usual port out."""
    return in_url(name) if port == 80 else f"{in_url(name)}:{port}"


def in_url(host: str) -> str:
    """A host as it stands in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def family(host: str) -> socket.AddressFamily:
    """IPv4 or IPv6."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def free_port(host: str) -> int:
    """A port of `host` that nobody listens on."""
    with socket.socket(family(host)) as probe:
        probe.bind((host, 0))
        return probe.getsockname()[1]
