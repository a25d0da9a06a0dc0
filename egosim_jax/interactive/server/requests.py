"""Requests of clients: their fields, and the checks of names, numbers, prompts and maps."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

from egosim_jax.interactive.env.action_spec import to_numbers
from egosim_jax.interactive.env.chunks import observation_names
from egosim_jax.io.bounded import quote
from egosim_jax.io.digest import fingerprint
from egosim_jax.simulation.rig import MAX_CAMERAS, MountedCamera
from egosim_jax.types import InputError

REQUESTS = {
    "create": ("session", "seed", "prompt", "episode", "actions", "observe", "cameras"),
    "step": ("session", "step_id", "part", "actions", "prompt", "observe", "stream"),
    "reset": ("session", "seed", "prompt", "episode", "observe"),
    "save": ("session", "name"),
    "load": ("session", "name", "observe"),
    "close": ("session", "keep"),
    "status": ("session",),
}
"""Fields of each request."""
NAMES = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""Valid names of sessions and saved starts."""
MAX_PROMPT = 2000
"""Maximum number of characters of a prompt."""


def parse_request(message: Any) -> tuple[str, Mapping[str, Any]]:
    """Return the name and fields of a request. Raises `InputError` for an unknown one."""
    if not isinstance(message, dict):
        raise InputError(
            f"The message is {quote(message)}: it must be a map with the field request."
        )
    name = message.get("request")
    if not isinstance(name, str) or name not in REQUESTS:
        raise InputError(
            f"The request is {quote(name)}: it must be one of {', '.join(REQUESTS)}. (request)"
        )
    fields = {key: value for key, value in message.items() if key != "request"}
    if unknown := [key for key in fields if key not in REQUESTS[name]]:
        raise InputError(
            f"The request {name} has no field {quote(unknown[0])}: its fields are "
            f"{', '.join(REQUESTS[name])}."
        )
    return name, fields


def is_streamed(message: Any) -> bool:
    """Return True if a message is a step whose frames are sent as they are decoded.

    Raises `InputError` if `stream` is not a boolean.
    """
    if not isinstance(message, dict) or message.get("request") != "step":
        return False
    if not isinstance(stream := message.get("stream", False), bool):
        raise InputError(f"stream is {quote(stream)}: it must be true or false. (stream)")
    return stream


def observations_of(
    request: Mapping[str, Any], cameras: Sequence[MountedCamera] = ()
) -> tuple[str, ...]:
    """Return the requested observations, by default the frames of the main camera."""
    names, known = request.get("observe", ["frames"]), observation_names(cameras)
    given = names if isinstance(names, list | tuple) else [names]
    if unknown := [n for n in given if not (isinstance(n, str) and n in known)]:
        raise InputError(
            f"observe has {quote(unknown[0])}: it must be a list of {', '.join(known)}."
        )
    return tuple(given)


def cameras_of(request: Mapping[str, Any]) -> tuple[MountedCamera, ...]:
    """Return the further cameras of a new session. Raises `InputError` for a bad declaration."""
    given = request.get("cameras", [])
    if not isinstance(given, list | tuple) or len(given) > MAX_CAMERAS:
        raise InputError(
            f"cameras is {quote(given)}: it must be a list of at most {MAX_CAMERAS} maps, one for "
            "each further camera. (cameras)"
        )
    return tuple(MountedCamera.from_json(fields) for fields in given)


def prompt_of(request: Mapping[str, Any]) -> str | None:
    """Return the prompt of a request, or None. Raises `InputError` for any other value."""
    prompt = request.get("prompt")
    if prompt is not None and not (isinstance(prompt, str) and len(prompt) <= MAX_PROMPT):
        raise InputError(
            f"prompt is {quote(prompt)}: it must be a text of at most {MAX_PROMPT} characters."
        )
    return prompt


def part_of(request: Mapping[str, Any]) -> int | None:
    """Return the part of a step, from 1; None for a step whose rows are given at once."""
    if request.get("part") is None:
        return None
    part = check_integer(request["part"], "part")
    if part < 1:
        raise InputError(f"part is {part}: it must be from 1 to the number of parts of a step.")
    return part


def check_name(name: object, field: str) -> str:
    """Return a name that is safe as a folder name. Raises `InputError` for any other."""
    if not isinstance(name, str) or not NAMES.fullmatch(name):
        raise InputError(
            f"{field} is {quote(name)}: it must have 1 to 64 letters, digits, _ or -, and begin "
            "with a letter or digit."
        )
    return name


def check_integer(value: object, field: str) -> int:
    """Return an integer, also one of NumPy. Raises `InputError` for any other value."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise InputError(f"{field} is {quote(value)}: it must be a whole number.")
    return int(value)


def check_mapping(value: object, field: str) -> Mapping[str, Any]:
    """Return a map with text keys. Raises `InputError` for any other value."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{field} is {quote(value)}: it must be a map from names to values.")
    return value


def request_hash(rows: object, prompt: str | None, part: int | None = None) -> str:
    """Return the hash that identifies a repeated step, or part of one.

    Raises `InputError` for invalid rows.
    """
    return fingerprint((to_numbers(rows), prompt, *([] if part is None else [part])))
