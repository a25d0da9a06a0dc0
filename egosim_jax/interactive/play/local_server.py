"""Server of the page of `egosim play`, for this machine alone."""

from __future__ import annotations

from functools import partial
from typing import Any

import viser
from websockets.asyncio import server

from egosim_jax.interactive.origins import is_local


class LocalServer(viser.ViserServer):
    """Page server for this machine alone: no foreign page and no public tunnel reaches it."""

    def __init__(self, host: str, port: int) -> None:
        # viser has no option for checks: it takes its websocket server from this module, here.
        serve = server.serve
        server.serve = partial(_serve_locally, serve)  # pyright: ignore[reportAttributeAccessIssue]
        try:
            super().__init__(host, port, verbose=False)
        finally:
            server.serve = serve

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse to publish the page."""


def _serve_locally(serve: Any, *args: Any, process_request: Any, **options: Any) -> Any:
    """Start a server of websockets that refuses requests of foreign pages."""

    def check(connection: Any, request: Any) -> Any:
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not all(is_local(hosts[0], origin) for origin in origins or [None]):
            return connection.respond(
                403, "The request is not from this page: open it as localhost or 127.0.0.1.\n"
            )
        return process_request(connection, request)

    return serve(*args, process_request=check, **options)
