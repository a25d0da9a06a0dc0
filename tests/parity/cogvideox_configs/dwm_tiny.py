"""DWM on CogVideoX, tiny: the released channels, strides and options."""

from egosim_jax.conditioning.layout import DWM
from egosim_jax.conditioning.text import BYT5_VOCAB, PromptTokenizer
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion import DDIM, Guidance, VariancePreserving
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.cogvideox.vae import CogVideoXVAEConfig
from egosim_jax.models.t5 import T5Config
from egosim_jax.types import VideoSpec

CONFIG = ModelConfig(
    name="dwm_tiny",
    video=VideoSpec(frames=9, height=32, width=48, fps=8),
    dit=CogVideoXDiTConfig(
        in_channels=49, dim=32, heads=2, layers=2, text_dim=16, time_dim=16, base_rows=2,
        base_columns=3,
    ),
    vae=CogVideoXVAEConfig(dims=(4, 4, 8, 8), res_blocks=1, groups=2),
    text=T5Config(vocab=BYT5_VOCAB, dim=16, ffn_dim=32, heads=2, head_dim=8, layers=2),
    image=None,
    layout=DWM,
    tokenizer=PromptTokenizer(clean=False, max_tokens=16),
    process=VariancePreserving(),
    solver=DDIM(),
    guidance=Guidance(scale=6.0),
    unconditional_prompt="",
    steps=2,
)  # fmt: skip
