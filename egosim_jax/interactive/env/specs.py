"""Action specs as JSON, of clients and in files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from egosim_jax.interactive.env.action_spec import ActionSpec, numbers
from egosim_jax.io.bounded import quote
from egosim_jax.types import InputError


def vars_of(actions: ActionSpec) -> dict[str, Any]:
    """Return the fields of an action spec as JSON."""
    return {
        "layout": actions.layout,
        "sides": list(actions.sides),
        "camera": actions.camera,
        "workspace_m": [list(corner) for corner in actions.workspace_m],
        "camera_reach": list(actions.camera_reach),
    }


def spec_of(fields: Mapping[str, Any]) -> ActionSpec:
    """Return the action spec of a client or file. Raises `InputError` for what is not one."""
    known = vars_of(ActionSpec())
    if unknown := sorted(fields.keys() - known.keys()):
        raise InputError(
            f"The actions have no setting {quote(unknown[0])}: choose from {', '.join(known)}."
        )
    given = {**known, **fields}
    corners, reach = given["workspace_m"], given["camera_reach"]
    shapes = _shape(corners) == (2, 3) and _shape(reach) == (2,)
    texts = isinstance(given["sides"], list) and all(isinstance(s, str) for s in given["sides"])
    if not (shapes and texts and isinstance(given["camera"], bool)):
        raise InputError(
            "The actions need sides, a list of 'left' and 'right', camera, true or false, "
            "workspace_m, two corners of three numbers in meters, and camera_reach, two numbers."
        )
    bounds: Any = {
        "workspace_m": tuple(tuple(map(float, corner)) for corner in corners),
        "camera_reach": tuple(map(float, reach)),
    }
    layout: Any = given["layout"]
    return ActionSpec(layout=layout, sides=tuple(given["sides"]), camera=given["camera"], **bounds)


def _shape(value: Any) -> tuple[int, ...] | None:
    try:
        return numbers(value).shape
    except InputError:
        return None
