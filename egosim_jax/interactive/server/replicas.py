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
from collections.abc import AsyncGenerator, Iterator, Mapping, Sequence
from contextlib import aclosing, contextmanager
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from egosim_jax.interactive.env import World
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.prometheus import Metrics
from egosim_jax.interactive.server.requests import REQUESTS, is_streamed
from egosim_jax.interactive.server.server import make_app
from egosim_jax.interactive.server.service import open_service
from egosim_jax.interactive.server.store import Limits
from egosim_jax.io.bounded import quote, quote_path, quote_text, read_json
from egosim_jax.io.run import write_json
from egosim_jax.types import InputError, check_counts

PARTS = "parts.json"
"""File with the number of parts, which is fixed once there are sessions."""
MAX_ONGOING = 1000
"""Maximum concurrent requests that Ray sends to a replica; its store has lower limits."""
DRAIN_TIMEOUT_S = 300.0
"""Maximum time that a stopped replica has to finish its running requests."""


@dataclass(frozen=True, kw_only=True)
class Replicas:
    """Settings of a deployment, given to `serve run` as NAME=VALUE."""

    out: Path
    """Folder that all machines share; each part has a subfolder."""
    parts: int = 2
    """Number of parts, each with one replica."""
    gpus: float = 0.0
    """GPUs per replica."""
    cpus: float = 1.0
    """CPU cores that Ray reserves per replica."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights; by default the packaged ones."""
    world: World = "generated"
    """World of the sessions: the model's, or the true tabletop world."""
    perception: str = "classical"
    """Perception pipeline: name and options."""
    steps: int | None = None
    """Number of denoising steps; by default the model's."""
    batch: int = 4
    """Maximum batch size of a replica, in clips."""
    sessions: int = 64
    """Maximum number of open sessions per replica."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless counts are positive and the folder is absolute."""
        check_counts({"parts": self.parts, "batch": self.batch, "sessions": self.sessions})
        check_counts({"steps": self.steps})
        if not self.out.is_absolute():
            raise InputError(
                f"out is {quote_path(self.out)}: it must be absolute, because replicas run in "
                "Ray's folders. Give the full path. (out)"
            )


def read_settings(given: Mapping[str, Any]) -> Replicas:
    """Return the settings of NAME=VALUE. Raises `InputError` for an unknown name or value."""
    from pydantic import TypeAdapter, ValidationError

    known = [field.name for field in fields(Replicas)]
    if unknown := sorted(given.keys() - set(known)):
        raise InputError(
            f"There is no setting {quote(unknown[0])}: choose from {', '.join(known)}."
        )
    try:
        return TypeAdapter(Replicas).validate_python(dict(given))
    except ValidationError as error:
        found = error.errors()[0]
        name = ".".join(map(str, found["loc"]))
        raise InputError(
            f"{name or 'A setting'} is {quote(found.get('input'))}: "
            f"{quote_text(str(found['msg']))}. Give it as NAME=VALUE."
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
    found = read_json(path)
    count = found.get("parts") if isinstance(found, dict) else None
    if count != settings.parts:
        raise InputError(
            f"{quote_path(settings.out)} has sessions in {quote(count)} parts, not "
            f"{settings.parts}: the number cannot change, because it selects the part of a "
            "session. Use that number, or choose another folder. (parts)"
        )


class Part:
    """Replica that serves one part of the sessions."""

    def __init__(self, settings: Replicas, number: int):
        self._service = open_service(
            settings.out / f"part-{number}",
            Limits(sessions=settings.sessions),
            world=settings.world,
            config=settings.config,
            weights=settings.weights,
            perception=settings.perception,
            steps=settings.steps,
            batch=settings.batch,
        )

    async def describe(self) -> dict[str, Any]:
        """Return the description of this part."""
        return await self._service.describe()

    async def handle(self, message: Any) -> dict[str, Any]:
        """Return the `reply` to a request, or the `error` for the client."""
        try:
            return {"reply": await self._service.handle(message)}
        except Exception as error:
            return {"error": self._service.metrics.refuse(error).body()}

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield each `reply` to a streamed step, or the `error` for the client."""
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


class Entrance:
    """Router of requests to the part of their session (`server.Requests`)."""

    def __init__(self, parts: Sequence[Any]):
        self._parts = parts
        self.metrics = Metrics()

    def __serve_build_asgi_app__(self) -> Any:
        """Return the application that Ray serves."""
        return make_app(self, token=os.environ.get("EGOSIM_TOKEN", "").strip() or None)

    def problem(self) -> str:
        """Return empty text: Ray itself starts a part again, and errors of a part are its own."""
        return ""

    async def describe(self) -> dict[str, Any]:
        """Return the description of a part (identical on all) and the number of parts."""
        return {**await self._parts[0].describe.remote(), "parts": len(self._parts)}

    @contextmanager
    def active(self) -> Iterator[None]:
        """Do nothing: Ray itself waits for running requests."""
        yield

    async def handle(self, message: Any) -> dict[str, Any]:
        """Return the reply of the session's part."""
        name = message.get("request") if isinstance(message, dict) else None
        if not isinstance(name, str) or name not in REQUESTS:
            return await self._ask(0, message)  # any part refuses it
        session = message.get("session")
        if name == "status" and session is None:
            return await self._status(message)
        if name == "create" and session is None:
            session = secrets.token_hex(8)
            message = {**message, "session": session}
        return await self._ask(part_of(str(session), len(self._parts)), message)

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the reply of the session's part, after the frames of a streamed step."""
        if not is_streamed(message):
            yield await self.handle(message)
            return
        number = part_of(str(message.get("session")), len(self._parts))
        with _restarts(number):
            streamed = self._parts[number].replies.options(stream=True).remote(message)
            async for found in streamed:
                yield _unwrap(found)

    async def _ask(self, number: int, message: Any) -> dict[str, Any]:
        with _restarts(number):
            return _unwrap(await self._parts[number].handle.remote(message))

    async def _status(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return the sessions of all parts."""
        asked = [self._ask(number, message) for number in range(len(self._parts))]
        found = await asyncio.gather(*asked)
        return {
            "sessions": {name: step for reply in found for name, step in reply["sessions"].items()},
            "damaged": [name for reply in found for name in reply["damaged"]],
            "draining": any(reply["draining"] for reply in found),
        }


@contextmanager
def _restarts(number: int) -> Iterator[None]:
    """Convert Ray's error for a stopped replica."""
    from ray.exceptions import RayError

    try:
        yield
    except RayError as error:
        raise RequestError(
            503,
            "part_restarts",
            f"The replica of part {number} has stopped; Ray restarts it, and it resumes its "
            "sessions. Send the same request again.",
            retry_after_s=5.0,
        ) from error


def _unwrap(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the reply of a part, or raise its error."""
    if "error" in found:
        body = dict(found["error"])
        raise RequestError(body.pop("status"), body.pop("code"), body.pop("message"), **body)
    return found["reply"]


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
