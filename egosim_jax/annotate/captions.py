"""Captions by a rule: the hands that are seen, and the objects that are known."""

from __future__ import annotations

from collections.abc import Sequence

from egosim_jax.types import Kind

RULE = "rule"
"""Source of such a caption in an annotation."""
SIDES = ("left", "right")
"""Names of the hands of an annotation, in their order."""


def caption_by_rule(seen: Sequence[bool], names: Sequence[str], kind: Kind) -> str:
    """Return a caption with the hands of a clip (left, right) and the names of objects.

    It does not name the action: without a network, no stage recognizes actions.
    """
    what = f" near {', '.join(names)}" if names else ""
    if kind == "robot":
        return f"A robot gripper moves in view of a camera{what}."
    sides = [side for side, present in zip(SIDES, seen, strict=False) if present]
    if not sides:
        return f"A wearer looks at a scene without moving hands in view{what}."
    who = (
        "The wearer's two hands move" if len(sides) == 2 else f"The wearer's {sides[0]} hand moves"
    )
    return f"{who} in view of a camera{what}."
