"""Conditioning inputs of the denoiser, and classifier-free dropout of them.

A dropped input has this value:

    prior   latents 0 and mask 1: nothing was observed, everything is to be generated
    mask    0: everything counts as observed, as in the EgoSim release without a mask file;
            the prior stays
    hands   latents 0
    text    embeddings 0, as the continuous runner of the EgoSim release has for an empty prompt;
            CogVideoX: the embeddings of `unconditional_prompt`

The CLIP tokens of the first frame are never dropped. If prior and mask are both dropped, the mask
is 1: nothing was observed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, no_type_check

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from egosim_jax.diffusion.objective import sample_keys
from egosim_jax.types import InputError

Name = Literal["prior", "mask", "hands", "text"]
"""Condition that can be dropped."""


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Condition:
    """Conditioning inputs of the denoiser, for a batch; latents are normalized.

    Mask, prior and hands are None where the model's `ChannelLayout` does not have them.
    """

    mask: Float[Array, "b f h w m"] | None = None
    """Packed mask: 1 = not observed, generate; 0 = observed, keep (`conditioning/mask.py`)."""
    prior: Float[Array, "b f h w z"] | None = None
    """Latents of the rendered scene, not masked."""
    hands: Float[Array, "b f h w z"] | None = None
    """Latents of the drawn hands."""
    text: Float[Array, "b n d"]
    """Embeddings of the prompt's tokens."""
    null_text: Float[Array, "b n d"] | None = None
    """Embeddings of the negative prompt; None: zeros."""
    image: Float[Array, "b m e"] | None = None
    """Image tokens of the first frame; None for models without the image branch."""

    def drop(self, name: Name, where: Bool[Array, " b"] | bool = True) -> Condition:
        """Return the condition without one of its inputs, in the samples of `where`."""
        if name == "text" and self.null_text is not None:
            where = jnp.asarray(where).reshape(-1, 1, 1)
            return replace(self, text=jnp.where(where, self.null_text, self.text))
        dropped = {name: _fill(getattr(self, name), where, 0)}
        if name == "prior":
            dropped["mask"] = _fill(self.mask, where, 1)
        return replace(self, **dropped)


def _fill(x: Array | None, where: Bool[Array, " b"] | bool, value: int) -> Array | None:
    """Replace whole samples by a constant."""
    if x is None:
        return None
    where = jnp.asarray(where).reshape(-1, *[1] * (x.ndim - 1))
    return jnp.where(where, jnp.asarray(value, x.dtype), x)


@dataclass(frozen=True, kw_only=True)
class ConditionDropout:
    """Rates at which training samples lose their conditions, each independently of the others.

    The denoiser so learns to work without any of them.
    """

    prior: float = 0.0
    """Dropout rate of the prior; its mask then says that nothing was observed."""
    mask: float = 0.0
    """Dropout rate of the mask; everything then counts as observed."""
    hands: float = 0.0
    """Dropout rate of the hands."""
    text: float = 0.0
    """Dropout rate of the prompt."""

    def __post_init__(self) -> None:
        for field in fields(self):
            rate = getattr(self, field.name)
            if not 0 <= rate <= 1:
                raise InputError(f"the dropout rate of {field.name} must be in [0, 1], not {rate}.")

    def apply(self, condition: Condition, key: Key[Array, " *keys"]) -> Condition:
        """Drop conditions; `key` is one key, or one for each sample."""
        keys = sample_keys(key, condition.text.shape[0])
        draws = jax.vmap(lambda k: jax.random.uniform(k, (4,)))(keys)
        rates = jnp.array([self.prior, self.mask, self.hands, self.text])
        prior, mask, hands, text = (draws < rates).T
        # The prior last: its mask of 1 must win over the dropped mask's 0.
        condition = condition.drop("mask", mask).drop("prior", prior)
        return condition.drop("hands", hands).drop("text", text)
