"""EgoSim's architecture with small sizes, for clips of 17 frames of 160 x 96 on a CPU.

Text and image encoder are small too, read bytes and 56 x 56 pixels, and are trained together with
the denoiser. `egosim train real_tiny` trains all of it.
"""

from egosim_jax.conditioning.text import BYT5_VOCAB, PromptTokenizer
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.process import RectifiedFlow
from egosim_jax.models.t5 import UMT5Config
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.types import VideoSpec

CONFIG = ModelConfig(
    name="real_tiny",
    video=VideoSpec(frames=17, height=96, width=160, fps=16),
    dit=WanDiTConfig(
        dim=192, ffn_dim=768, heads=3, layers=6, text_dim=64, image_dim=64, remat="products"
    ),
    vae=WanVAEConfig(
        dim=8,
        dim_mult=(1, 2, 4, 8),
        res_blocks=1,
        latent_mean=(0.0,) * 16,
        latent_std=(1.0,) * 16,
    ),
    text=UMT5Config(vocab=BYT5_VOCAB, dim=64, ffn_dim=128, heads=2, head_dim=32, layers=2),
    image=CLIPVisionConfig(image_size=56, dim=64, layers=3, heads=2, ffn_dim=128),
    tokenizer=PromptTokenizer(kind="byt5", max_tokens=128),
    encoders="joint",
    process=RectifiedFlow(shift=3.0),
    steps=10,
)
TRAINING = "egosim train real_tiny --metadata clips.csv --out runs/real_tiny"
"""Command that trains the weights."""
