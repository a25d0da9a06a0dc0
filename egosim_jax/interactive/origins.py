"""Addresses to listen on, and checks that a request comes from this machine and its own page."""

from __future__ import annotations

import ipaddress
import socket
from urllib.parse import urlsplit

from egosim_jax.types import InputError


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
        same_page = origin is None or urlsplit(origin).netloc == host
    except ValueError:
        return False
    return same_page and is_loopback(name)


def bind(host: str, port: int, *, token: str | None) -> socket.socket:
    """Bind a socket to an address; port 0 chooses a free one.

    Raises `InputError` if the port is invalid or in use, and for a public address without a token.
    """
    if not 0 <= port < 1 << 16:
        raise InputError(f"--port must be from 0 to 65535, not {port}.")
    if not is_loopback(host) and not token:
        raise InputError(
            f"{host} is reachable from other machines: the server needs a token to listen on it. "
            "Set EGOSIM_TOKEN, or listen on 127.0.0.1. (--host)"
        )
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        raise InputError(
            f"Cannot listen on {host}:{port} ({error.strerror}): the address must belong to this "
            "machine, and the port must be free. Choose another port, 0 for any free one. (--port)"
        ) from error
    return bound
