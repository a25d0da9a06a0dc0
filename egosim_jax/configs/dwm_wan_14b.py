"""DWM on Wan 2.1 Fun V1.1 14B InP: 49 frames of 720 x 480 at 8 per second, as it was released.

The prior is observed everywhere: the mask is 1, which means keep. The released model generates with
CLIP tokens of zeros. It was trained without them: the first 257 tokens of the prompt took their
place. Here training and generation both use zeros. 50 Euler steps with guidance away from a short
negative prompt.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from egosim_jax.conditioning.layout import DWM_WAN
from egosim_jax.conditioning.text import PromptTokenizer
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.guidance import Guidance
from egosim_jax.diffusion.process import RectifiedFlow
from egosim_jax.models.t5 import UMT5Config
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.types import VideoSpec


@dataclass(frozen=True, kw_only=True)
class DWMWanDiTConfig(WanDiTConfig):
    """Wan's transformer; DWM adapts every linear layer and trains the patch embedding."""

    table: ClassVar[str] = "egosim_jax.convert.tables.dwm_wan_dit"
    """Module of the conversion table."""
    lora_targets: ClassVar[tuple[str, ...]] = ("*",)
    """Patterns of the linear layers that a LoRA adapts: all 488 of the 14B model."""
    also_train: ClassVar[tuple[str, ...]] = ("patch.*",)
    """Patterns of the weights that are trained in full along with a LoRA."""


CONFIG = ModelConfig(
    name="dwm_wan_14b",
    video=VideoSpec(frames=49, height=480, width=720, fps=8),
    dit=DWMWanDiTConfig(dtype="bfloat16", remat="attention"),
    vae=WanVAEConfig(dtype="bfloat16"),
    text=UMT5Config(dtype="bfloat16"),
    image=None,
    zero_image_tokens=257,
    layout=DWM_WAN,
    tokenizer=PromptTokenizer(kind=Path("google/umt5-xxl"), max_tokens=512),
    process=RectifiedFlow(shift=5.0),
    guidance=Guidance(scale=6.0),
    unconditional_prompt="bad detailed",
    steps=50,
)
