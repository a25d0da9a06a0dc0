"""Baselines of a conditioned video model, by the same weights with other conditions.

    no_hands    without the hands: what a video model makes of the scene alone (Wan-InP in EgoSim)
    hand_mask   with the silhouette of the hands instead of their drawing (DWM, Table 3)
    sdedit      from the noised prior, without prior, mask and hands as conditions (SDEdit, Meng et
                al. 2022; CVX SDEdit in DWM, Table 1)

As in the papers the models of the first two are also trained so; weights trained with hands lose
more without them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from egosim_jax.conditioning.condition import Name
from egosim_jax.rendering.mesh import hand_mask
from egosim_jax.types import Triplet

Baseline = Literal["no_hands", "hand_mask", "sdedit"]
STRENGTH = 0.75
"""Share of the noise levels at which SDEdit begins (DWM)."""
DROPPED: dict[Baseline, Name | None] = {"no_hands": "hands", "hand_mask": None, "sdedit": "hands"}
"""Condition that a baseline does without; SDEdit's sampling drops prior and mask as well."""


def with_hand_mask(triplet: Triplet) -> Triplet:
    """Return the triplet with hands in white wherever they are drawn."""
    return replace(triplet, hands=hand_mask(triplet.hands))
