"""Sessions on several machines: replicas of Ray Serve, each of which has a part of the sessions.

    serve run egosim_jax.interactive.server.replicas:app out=/shared/serve parts=4 gpus=1

The hash of a session's id chooses its part, whose one replica holds the folder OUT/part-N. If a
replica or its machine fails, Ray starts it again, and it resumes its sessions as `egosim serve`
does. Clients connect to Ray's proxy of any machine as to one server. Needs the extra `replicas`.
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
from egosim_jax.interactive.server.server import make_app
from egosim_jax.interactive.server.service import FIELDS, is_streamed, open_service, refusal
from egosim_jax.interactive.server.store import Limits
from egosim_jax.io.bounded import quote, quote_path, quote_text, read_json
from egosim_jax.io.run import write_json
from egosim_jax.types import InputError, check_counts

PARTS = "parts.json"
"""File of the number of parts, which cannot change while there are sessions."""
ONGOING = 1000
"""Most requests that Ray sends to a replica at a time, above the limits of its store."""
DRAIN_S = 300.0
"""Longest time that a replica that is stopped has for the requests under way."""


@dataclass(frozen=True, kw_only=True)
class Replicas:
    """Settings of a deployment, which `serve run` takes as NAME=VALUE."""

    out: Path
    """Folder that all machines see; each part of the sessions has a folder in it."""
    parts: int = 2
    """Number of parts, each with one replica."""
    gpus: float = 0.0
    """GPUs of a replica."""
    cpus: float = 1.0
    """CPU cores that Ray reserves for a replica."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights, if not those that come with the package."""
    world: World = "generated"
    """World of the sessions: the model's, or the tabletop world itself."""
    perception: str = "classical"
    """Perception pipeline by name, with its options."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    batch: int = 4
    """Most clips that a replica generates together."""
    sessions: int = 64
    """Most open sessions of a replica."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless counts are positive and the folder is absolute."""
        check_counts({"parts": self.parts, "batch": self.batch, "sessions": self.sessions})
        check_counts({"steps": self.steps})
        if not self.out.is_absolute():
            raise InputError(
                f"out is {quote_path(self.out)}: it must be absolute, as replicas run in folders "
                "of Ray. Give the whole path. (out)"
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
    """Return the part that has a session."""
    name = session.encode("utf-8", "surrogatepass")  # of JSON, which may have half a pair
    return int.from_bytes(hashlib.sha256(name).digest()[:8]) % parts


def keep_parts(settings: Replicas) -> None:
    """Record the number of parts. Raises `InputError` if the folder has another one."""
    path = settings.out / PARTS
    if not path.exists():
        settings.out.mkdir(parents=True, exist_ok=True)
        write_json(path, {"parts": settings.parts})
    found = read_json(path)
    count = found.get("parts") if isinstance(found, dict) else None
    if count != settings.parts:
        raise InputError(
            f"{quote_path(settings.out)} has sessions in {quote(count)} parts, not "
            f"{settings.parts}: the number cannot change, as it chooses the part of a session. "
            "Start it with that number, or choose another folder. (parts)"
        )


class Part:
    """Replica that has one part of the sessions."""

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
        """Return the description of the world and the limits of this part."""
        return await self._service.describe()

    async def handle(self, message: Any) -> dict[str, Any]:
        """Return the `reply` to a request, or the `error` for the client."""
        try:
            return {"reply": await self._service.handle(message)}
        except Exception as error:
            return {"error": self._service.refused(error).body()}

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield each `reply` to a streamed step, or the `error` for the client."""
        async with aclosing(self._service.replies(message)) as replies:
            try:
                async for reply in replies:
                    yield {"reply": reply}
            except Exception as error:
                yield {"error": self._service.refused(error).body()}

    def __del__(self) -> None:
        """Finish the steps under way; Ray calls it before it stops a replica."""
        if hasattr(self, "_service"):
            self._service.store.close()


class Entrance:
    """Requests of clients, each passed to the part of its session (`server.Requests`)."""

    def __init__(self, parts: Sequence[Any]):
        self._parts = parts
        self.metrics, self.draining = Metrics(), False

    def __serve_build_asgi_app__(self) -> Any:
        """Return the application that Ray serves."""
        return make_app(self, token=os.environ.get("EGOSIM_TOKEN", "").strip() or None)

    async def describe(self) -> dict[str, Any]:
        """Return the description of the first part, which is that of all, and their number."""
        return {**await self._parts[0].describe.remote(), "parts": len(self._parts)}

    @contextmanager
    def active(self) -> Iterator[None]:
        """Count nothing: Ray waits for the requests under way."""
        yield

    def refused(self, error: Exception) -> RequestError:
        """Count the error of a request and return it for the client."""
        return refusal(error, self.metrics)

    async def handle(self, message: Any) -> dict[str, Any]:
        """Return the reply of the part that has the session."""
        name = message.get("request") if isinstance(message, dict) else None
        if not isinstance(name, str) or name not in FIELDS:
            return await self._ask(0, message)  # which refuses it
        session = message.get("session")
        if name == "status" and session is None:
            return await self._status(message)
        if name == "create" and session is None:
            session = secrets.token_hex(8)
            message = {**message, "session": session}
        return await self._ask(part_of(str(session), len(self._parts)), message)

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the reply of the part that has the session, after frames that it streams."""
        if not is_streamed(message):
            yield await self.handle(message)
            return
        number = part_of(str(message.get("session")), len(self._parts))
        with _restarts(number):
            streamed = self._parts[number].replies.options(stream=True).remote(message)
            async for found in streamed:
                yield _opened(found)

    async def _ask(self, number: int, message: Any) -> dict[str, Any]:
        with _restarts(number):
            return _opened(await self._parts[number].handle.remote(message))

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
    """Turn the error of Ray for a part that has stopped into that for the client."""
    from ray.exceptions import RayError

    try:
        yield
    except RayError as error:
        raise RequestError(
            503,
            "part_restarts",
            f"The replica of part {number} has stopped; Ray starts it again and it resumes its "
            "sessions. Send the same request again.",
            retry_after_s=5.0,
        ) from error


def _opened(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the reply that a part has sent. Raises its error."""
    if "error" in found:
        body = dict(found["error"])
        raise RequestError(body.pop("status"), body.pop("code"), body.pop("message"), **body)
    return found["reply"]


def app(args: dict[str, str]) -> Any:
    """Return the application for `serve run` and `serve build`.

    Raises `InputError` for settings that are not valid, or without Ray Serve.
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
        "max_ongoing_requests": ONGOING,
        "graceful_shutdown_timeout_s": DRAIN_S,
    }
    resources = {"num_gpus": settings.gpus, "num_cpus": settings.cpus}
    part = serve.deployment(Part).options(ray_actor_options=resources, **common)
    parts = [
        part.options(name=f"part-{number}").bind(settings, number)
        for number in range(settings.parts)
    ]
    entrance = serve.deployment(serve.ingress()(Entrance))
    return entrance.options(name="entrance", **common).bind(parts)
