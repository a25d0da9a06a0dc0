"""Input channels of the denoiser: the only place that knows their order.

A layout is a value in the model's config. The default is EgoSim's:

    0-15    noisy latents
    16-19   mask, 1 = generate (`mask.py`)
    20-35   prior latents x (1 - mask channel 0)
    36-51   hands latents, not masked

Its prior is masked in latent space and by the first of the four mask channels alone: an unobserved
cell is latent 0, not the latent of gray or black (EgoSim release).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.mask import Packing, halve_mask, pack_mask
from egosim_jax.data.static import check_observed
from egosim_jax.diffusion.progressive import means
from egosim_jax.types import InputError, VideoGrid

Part = Literal["noisy", "mask", "prior", "hands"]
PACKED: dict[Packing, int] = {"space": 4, "single": 1}
"""Mask channels of a packing that has a fixed number."""


@dataclass(frozen=True, kw_only=True)
class ChannelLayout:
    """Order, number and meaning of the denoiser's input channels; the default is EgoSim's."""

    parts: tuple[tuple[Part, int], ...] = (
        ("noisy", 16), ("mask", 4), ("prior", 16), ("hands", 16),
    )  # fmt: skip
    """Name and number of channels of each part, in order; the noisy latents come first."""
    mask_packing: Packing = "space"
    """Pixels of the mask in a latent cell.

    `space`: 2 x 2 pixels of one frame in 4 channels (EgoSim). `time`: one pixel of each pixel frame
    (Wan's inpainting models). `single`: one pixel. `observed`: no pixels, as everything must be
    observed and the mask is constant (DWM); a mask with holes raises `InputError`.
    """
    mask_one: Literal["generate", "keep"] = "generate"
    """Meaning of a mask of 1 to the denoiser: `generate` (EgoSim) or `keep` (Wan, CogVideoX)."""
    mask_scale: float = 1.0
    """Factor of the mask's channels."""
    mask_prior: bool = True
    """Multiply the prior's latents by 0 where the first mask channel says generate."""

    def __post_init__(self) -> None:
        names = [name for name, _ in self.parts]
        if unknown := [name for name in names if name not in get_args(Part)]:
            raise InputError(
                f"A channel layout has no part {', '.join(unknown)}: all parts are "
                f"{', '.join(get_args(Part))}. (layout.parts)"
            )
        if names[:1] != ["noisy"] or len({*names}) < len(names):
            raise InputError(
                f"The parts of a channel layout are {', '.join(names) or 'none'}: noisy must come "
                "first, and every part once. (layout.parts)"
            )
        if min(channels for _, channels in self.parts) < 1:
            raise InputError(
                f"Every part of a channel layout needs a channel: {self.parts}. (layout.parts)"
            )
        wanted = PACKED.get(self.mask_packing)
        if "mask" in self and wanted not in (None, self.count("mask")):
            raise InputError(
                f"The mask has {self.count('mask')} channels, but the packing {self.mask_packing} "
                f"gives {wanted}. (layout.parts, layout.mask_packing)"
            )

    def __contains__(self, part: Part) -> bool:
        """Return whether the denoiser has input channels for a part."""
        return part in dict(self.parts)

    @property
    def channels(self) -> int:
        """Number of all input channels."""
        return sum(channels for _, channels in self.parts)

    def count(self, part: Part) -> int:
        """Return the number of channels of a part, 0 if the layout does not have it."""
        return dict(self.parts).get(part, 0)

    def slice(self, part: Part) -> slice:
        """Return the channels of a part."""
        names = [name for name, _ in self.parts]
        start = sum(channels for _, channels in self.parts[: names.index(part)])
        return slice(start, start + self.count(part))

    def pack_mask(
        self, frames: UInt8[np.ndarray, "f h w"], grid: VideoGrid
    ) -> UInt8[np.ndarray, "lf lh lw m"]:
        """Pack a gray mask video (255 = not observed) into the mask's channels."""
        return pack_mask(frames, packing=self.mask_packing, channels=self.count("mask"), grid=grid)

    def check_mask(self, frames: UInt8[np.ndarray, "f h w"]) -> None:
        """Raise `InputError` for a mask video with holes, if the model has a constant mask."""
        if self.mask_packing == "observed":
            check_observed(frames)

    def condition_channels(
        self, condition: Condition, noisy: Float[Array, "b f h w z"]
    ) -> Float[Array, "b f h w c"]:
        """Return the channels after the noisy ones; they do not change between denoising steps.

        Their dtype is the prior's, or else the hands', or else the noisy latents'. Of the noisy
        latents only shape and dtype matter.
        """
        found = (condition.prior, condition.hands, noisy)
        dtype = next(array.dtype for array in found if array is not None)
        channels = []
        for part, _ in self.parts[1:]:
            array = getattr(condition, part)
            if array is None:
                raise InputError(f"The model's layout has {part} channels; the condition has none.")
            array = jnp.asarray(array, dtype)
            if part == "mask":
                array = self.mask_value(array)
            elif part == "prior" and self.mask_prior and condition.mask is not None:
                array = array * (1 - jnp.asarray(condition.mask, dtype)[..., :1])
            channels.append(array)
        return jnp.concatenate(channels, axis=-1) if channels else noisy[..., :0]

    def halve(self, condition: Condition) -> Condition:
        """Return a condition on half the rows and columns of its latent grid.

        Latents become the means of 2 x 2 cells, a masked prior's of the observed cells among them.
        """
        mask, prior, hands = condition.mask, condition.prior, condition.hands
        if prior is not None and mask is not None and self.mask_prior:
            observed = 1 - jnp.asarray(mask, prior.dtype)[..., :1]
            # A block without an observed cell has the sum 0; its quotient must be finite.
            prior = means(prior * observed) / jnp.maximum(means(observed), 1 / 8)
        elif prior is not None:
            prior = means(prior)
        return replace(
            condition,
            mask=None if mask is None else halve_mask(mask, self.mask_packing),
            prior=prior,
            hands=None if hands is None else means(hands),
        )

    def mask_value(self, mask: Float[Array, "*b m"]) -> Float[Array, "*b m"]:
        """Return the denoiser's input for a mask of 1 = generate."""
        mask = 1 - mask if self.mask_one == "keep" else mask
        return mask if self.mask_scale == 1 else self.mask_scale * mask

    def assemble(
        self, noisy: Float[Array, "b f h w z"], condition: Condition
    ) -> Float[Array, "b f h w c"]:
        """Return the denoiser's input: noisy latents, then the condition's channels."""
        return jnp.concatenate([noisy, self.condition_channels(condition, noisy)], axis=-1)


EGOSIM = ChannelLayout()
"""EgoSim: 52 channels."""
DWM = ChannelLayout(
    parts=(("noisy", 16), ("mask", 1), ("prior", 16), ("hands", 16)),
    mask_packing="observed",
    mask_one="keep",
    mask_scale=0.7,
    mask_prior=False,
)
"""DWM on CogVideoX: 49 channels; the mask is constant, the scale of the VAE's latents."""
DWM_WAN = ChannelLayout(mask_packing="observed", mask_one="keep", mask_prior=False)
"""DWM on Wan 2.1 Fun InP: EgoSim's 52 channels, with a constant mask of 1."""
COGVIDEOX_INPAINT = ChannelLayout(
    parts=(("noisy", 16), ("mask", 1), ("prior", 16)),
    mask_packing="single",
    mask_one="keep",
    mask_scale=0.7,
    mask_prior=False,
)
"""CogVideoX-Fun V1.1 InP: 33 channels; the prior is masked in pixels."""
WAN_INPAINT = ChannelLayout(
    parts=(("noisy", 16), ("mask", 4), ("prior", 16)),
    mask_packing="time",
    mask_one="keep",
    mask_prior=False,
)
"""Wan 2.1 image to video and Wan 2.1 Fun InP: 36 channels; the prior is masked in pixels."""
