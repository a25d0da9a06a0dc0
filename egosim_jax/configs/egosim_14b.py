"""EgoSim-14B as released: 61 frames of 832 x 480, all networks in bfloat16, 50 Euler steps.

The weights were trained with three quirks: CLIP's input is in [0, 1], timesteps are rounded to
bfloat16 before they are embedded, and there is no guidance.
"""

from pathlib import Path

from egosim_jax.conditioning.text import PromptTokenizer
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.process import RectifiedFlow
from egosim_jax.models.t5 import UMT5Config
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.types import VideoSpec

CONFIG = ModelConfig(
    name="egosim_14b",
    video=VideoSpec(frames=61, height=480, width=832, fps=16),
    dit=WanDiTConfig(dtype="bfloat16", remat="attention"),
    vae=WanVAEConfig(dtype="bfloat16"),
    text=UMT5Config(dtype="bfloat16"),
    image=CLIPVisionConfig(dtype="bfloat16"),
    tokenizer=PromptTokenizer(kind=Path("google/umt5-xxl"), max_tokens=512),
    image_range="unit",
    process=RectifiedFlow(shift=5.0, timestep_rounding="bfloat16"),
    steps=50,
)
