"""Host names of local servers, and checks of a request's headers."""

import socket
from collections.abc import Callable
from urllib.parse import urlsplit

Header = Callable[[str], str | None]
"""maps a header's name to its value in a request"""
WILDCARDS = ("0.0.0.0", "::", "")
"""hosts that mean every address of this machine"""


def local_host(host: str) -> str:
    """The address under which this machine reaches a server bound to `host`."""
    return "127.0.0.1" if host in WILDCARDS else host


def refusal(header: Header, host: str, *, proxied: bool = False) -> str | None:
    """Why the server bound to `host` refuses a request; None if it answers.

    It answers requests to its own names, and only its own pages. Behind a proxy (`proxied`) it has
    any name to which a browser speaks in secret. Programs other than browsers can set any header.
    """
    asked, origin = header("Host") or "", header("Origin")
    if not (_is_own_name(asked, host) or (proxied and _is_secure(header))):
        return "this address is served under its own name only, or by a proxy with https"
    if origin is None:  # foreign, if a page of another origin loads this as an image, a script, ...
        elsewhere = header("Sec-Fetch-Site") in ("same-site", "cross-site")
        embedded = elsewhere and header("Sec-Fetch-Mode") != "navigate"
        foreign = embedded or (header("Upgrade") or "").lower() == "websocket"
    else:
        schemes = ("http", "https") if proxied else ("http",)
        foreign = origin.lower() not in [f"{scheme}://{asked.lower()}" for scheme in schemes]
    return "this address answers its own pages only" if foreign else None


def _is_own_name(asked: str, host: str) -> bool:
    """Whether a Host header is a name of the server bound to `host`; its port may be a tunnel's.

    Otherwise a page under another name of this address could read the server's content.
    """
    if host in WILDCARDS:
        return bool(asked)
    try:
        return urlsplit(f"//{asked}").hostname in (host.lower(), "localhost", "127.0.0.1")
    except ValueError:
        return False


def _is_secure(header: Header) -> bool:
    """Whether a browser asks over https.

    A page whose name was made to point here (DNS rebinding) cannot: it has no certificate. Only for
    https, and for this machine, browsers send Sec-Fetch-Site.
    """
    origin = header("Origin")
    return header("Sec-Fetch-Site") is not None if origin is None else origin.startswith("https://")


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
