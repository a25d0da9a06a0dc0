"""Sessions on several machines, sharded over replicas of Ray Serve.

    serve run egosim_jax.interactive.server.replicas:app out=/shared/serve parts=4 gpus=1

A hash of the session id selects its part. One replica serves each part, from the folder OUT/part-N.
If a replica or its machine fails, Ray restarts it, and it resumes its sessions like `egosim serve`.
Clients connect to Ray's proxy on any machine, as to one server. Needs the extra `replicas`.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import secrets
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from egosim_jax.interactive.env import World
from egosim_jax.interactive.options import ClipOptions, Limits
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.prometheus import Metrics
from egosim_jax.interactive.server.requests import REQUESTS
from egosim_jax.interactive.server.server import DRAIN_TIMEOUT_S, make_app
from egosim_jax.interactive.server.service import Requests, last_of, open_service
from egosim_jax.io.bounded import quote, quote_path, quote_text, read_json
from egosim_jax.io.run import write_json
from egosim_jax.types import InputError, check_counts

PARTS = "parts.json"
"""File with the number of parts, which is fixed once there are sessions."""
MAX_ONGOING = 1000
"""Maximum concurrent requests that Ray sends to a replica; its store has lower limits."""


@dataclass(frozen=True, kw_only=True)
class Replicas(ClipOptions):
    """Settings of a deployment, given to `serve run` as NAME=VALUE."""

    out: Path
    """Folder that all machines share; each part has a subfolder."""
    parts: int = 2
    """Number of parts, each with one replica."""
    gpus: float = 0.0
    """GPUs per replica."""
    cpus: float = 1.0
    """CPU cores that Ray reserves per replica."""
    world: World = "generated"
    """World of the sessions: the model's, or the true tabletop world."""
    batch: int = 4
    """Maximum batch size of a replica, in clips."""
    sessions: int = 64
    """Maximum number of open sessions per replica."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless counts are positive and the folder is absolute."""
        super().__post_init__()
        check_counts({"parts": self.parts, "batch": self.batch, "sessions": self.sessions})
        if not self.out.is_absolute():
            raise InputError(
                f"out is {quote_path(self.out)}: it must be absolute, because replicas run in "
                "Ray's folders. Give the full path. (out)"
            )


def read_settings(given: Mapping[str, Any]) -> Replicas:
    """Return the settings of NAME=VALUE. Raises `InputError` for an unknown name or value."""
    from pydantic import TypeAdapter, ValidationError

    names = [field.name for field in fields(Replicas)]
    if unknown := sorted(given.keys() - set(names)):
        raise InputError(
            f"There is no setting {quote(unknown[0])}: choose from {', '.join(names)}."
        )
    try:
        return TypeAdapter(Replicas).validate_python(dict(given))
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{name or 'A setting'} is {quote(first.get('input'))}: "
            f"{quote_text(str(first['msg']))}. Give it as NAME=VALUE."
        ) from error


def part_of(session: str, parts: int) -> int:
    """Return the part of a session."""
    name = session.encode("utf-8", "surrogatepass")  # JSON may contain a lone surrogate
    return int.from_bytes(hashlib.sha256(name).digest()[:8]) % parts


def keep_parts(settings: Replicas) -> None:
    """Record the number of parts. Raises `InputError` if the folder has another number."""
    path = settings.out / PARTS
    if not path.exists():
        settings.out.mkdir(parents=True, exist_ok=True)
        write_json(path, {"parts": settings.parts})
    recorded = read_json(path)
    count = recorded.get("parts") if isinstance(recorded, dict) else None
    if count != settings.parts:
        raise InputError(
            f"{quote_path(settings.out)} has sessions in {quote(count)} parts, not "
            f"{settings.parts}: the number cannot change, because it selects the part of a "
            "session. Use that number, or choose another folder. (parts)"
        )


class Part:
    """Replica that serves one part of the sessions."""

    def __init__(self, settings: Replicas, number: int):
        names = "world", "batch", *(field.name for field in fields(ClipOptions))
        options = {name: getattr(settings, name) for name in names}
        limits = Limits(sessions=settings.sessions)
        self._service = open_service(settings.out / f"part-{number}", limits, **options)

    async def describe(self) -> dict[str, Any]:
        """Return the description of this part."""
        return await self._service.describe()

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield each `reply` to a request, or the `error` for the client."""
        async with aclosing(self._service.replies(message)) as replies:
            try:
                async for reply in replies:
                    yield {"reply": reply}
            except Exception as error:
                yield {"error": self._service.metrics.refuse(error).body()}

    def __del__(self) -> None:
        """Finish the running steps. Ray calls it before it stops a replica."""
        if hasattr(self, "_service"):
            self._service.store.close()


class Entrance(Requests):
    """Router of requests to the part of their session."""

    def __init__(self, parts: Sequence[Any]):
        super().__init__(Metrics())
        self._parts = parts

    def __serve_build_asgi_app__(self) -> Any:
        """Return the application that Ray serves."""
        return make_app(self, token=os.environ.get("EGOSIM_TOKEN", "").strip() or None)

    async def describe(self) -> dict[str, Any]:
        """Return the description of a part (identical on all) and the number of parts."""
        return {**await self._parts[0].describe.remote(), "parts": len(self._parts)}

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the reply of the session's part, after the frames of a streamed step."""
        name = message.get("request") if isinstance(message, dict) else None
        number = 0  # any part refuses an unknown request
        if isinstance(name, str) and name in REQUESTS:
            session = message.get("session")
            if name == "status" and session is None:
                yield await self._status(message)
                return
            if name == "create" and session is None:
                session = secrets.token_hex(8)
                message = {**message, "session": session}
            number = part_of(str(session), len(self._parts))
        async for reply in self._ask(number, message):
            yield reply

    async def _ask(self, number: int, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the replies of a part, or raise its error."""
        from ray.exceptions import RayError

        try:
            async for given in self._parts[number].replies.options(stream=True).remote(message):
                if "error" in given:
                    body = dict(given["error"])
                    status, code, text = (body.pop(name) for name in ("status", "code", "message"))
                    raise RequestError(status, code, text, **body)
                yield given["reply"]
        except RayError as error:
            raise RequestError(
                503,
                "part_restarts",
                f"The replica of part {number} has stopped; Ray restarts it, and it resumes its "
                "sessions. Send the same request again.",
                retry_after_s=5.0,
            ) from error

    async def _status(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return the sessions of all parts."""
        asked = [last_of(self._ask(number, message)) for number in range(len(self._parts))]
        replies = await asyncio.gather(*asked)
        return {
            "sessions": {name: n for reply in replies for name, n in reply["sessions"].items()},
            "damaged": [name for reply in replies for name in reply["damaged"]],
            "draining": any(reply["draining"] for reply in replies),
        }


def app(args: dict[str, str]) -> Any:
    """Return the application for `serve run` and `serve build`.

    Raises `InputError` for invalid settings, and without Ray Serve.
    """
    settings = read_settings(args)
    if find_spec("ray") is None or find_spec("grpc") is None:
        raise InputError(
            "Replicas need Ray Serve, which is not installed: pip install 'egosim-jax[replicas]'."
        )
    import ray.serve

    serve: Any = ray.serve
    keep_parts(settings)
    common: Any = {
        "num_replicas": 1,
        "max_ongoing_requests": MAX_ONGOING,
        "graceful_shutdown_timeout_s": DRAIN_TIMEOUT_S,
    }
    resources = {"num_gpus": settings.gpus, "num_cpus": settings.cpus}
    part = serve.deployment(Part).options(ray_actor_options=resources, **common)
    parts = [
        part.options(name=f"part-{number}").bind(settings, number)
        for number in range(settings.parts)
    ]
    entrance = serve.deployment(serve.ingress()(Entrance))
    return entrance.options(name="entrance", **common).bind(parts)
