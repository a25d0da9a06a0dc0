"""Checks that a request comes from this machine, and from the page of the server itself."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Return True if a host is this machine's loopback."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_local(host: str, origin: str | None) -> bool:
    """Return True if a request is addressed to the loopback, and not sent by a foreign page.

    A page that rebinds its own name to the loopback sends that name as `host`.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
        own = origin is None or urlsplit(origin).netloc == host
    except ValueError:
        return False
    return own and is_loopback(name)
