"""By which names a page on this machine may be asked for."""

from __future__ import annotations

import ipaddress
import socket

__all__ = ["LOOPBACK", "is_everywhere", "own_names"]

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def own_names(host: str) -> tuple[frozenset[str], bool]:
    """The names that a page served on ``host`` answers to, in lower case, and whether to every number as well.

    Example:
        >>> sorted(own_names("10.0.0.7")[0]), own_names("10.0.0.7")[1]
        (['10.0.0.7', '127.0.0.1', '::1', 'localhost'], False)
    """
    names = {*LOOPBACK, host.lower()}
    if is_everywhere(host):
        names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return frozenset(names - {""}), is_everywhere(host)


def is_everywhere(host: str) -> bool:
    """Whether serving on ``host`` means every address of the machine."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return host == ""
