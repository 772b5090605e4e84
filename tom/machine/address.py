"""Hosts that a server is bound to: how this machine reaches them, and under which names."""

import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

WILDCARDS = ("0.0.0.0", "::", "")
"""every address of this machine"""


def local_host(host: str) -> str:
    """A host that a server is bound to, as this machine itself reaches it."""
    return "127.0.0.1" if host in WILDCARDS else host


def names(host: str) -> list[str]:
    """The names that a browser may use for a host; empty means any."""
    return [] if host in WILDCARDS else [host.lower(), "localhost", "127.0.0.1"]


def allowed(header: str, names: Sequence[str]) -> bool:
    """A request's Host header says one of `names`; without names it may say anything.

    A page on another name for this address could otherwise read what is served here.
    """
    try:
        return not names or urlsplit(f"//{header}").hostname in names
    except ValueError:
        return False


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
