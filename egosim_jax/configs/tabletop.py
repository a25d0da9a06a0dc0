"""Model shipped with the package: small, and trained only on the tabletop world.

Trained from scratch by `egosim train tabletop`; its weights are in the package and its card
in `weights/tabletop/README.md`.
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
    name="tabletop",
    video=VideoSpec(frames=17, height=96, width=160, fps=8),
    dit=WanDiTConfig(
        dim=256, ffn_dim=768, heads=4, layers=10, text_dim=64, image_dim=64, remat="products"
    ),
    vae=WanVAEConfig(
        dim=8,
        decoder_dim=11,
        dim_mult=(1, 2, 6, 10),
        res_blocks=1,
        latent_mean=(0.0,) * 16,
        latent_std=(1.0,) * 16,
    ),
    text=UMT5Config(vocab=BYT5_VOCAB, dim=64, ffn_dim=128, heads=2, head_dim=32, layers=2),
    image=CLIPVisionConfig(image_size=56, dim=64, layers=3, heads=2, ffn_dim=128),
    tokenizer=PromptTokenizer(kind="byt5", max_tokens=96),
    point_px=1,
    prior="predicted",
    encoders="joint",
    process=RectifiedFlow(shift=3.0),
    steps=2,
)
