"""The toy model: 19 channels, a mask of 0.7 where pixels are kept, v-prediction, 7 frames."""

from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.conditioning.text import PromptTokenizer
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.process import VariancePreserving
from egosim_jax.diffusion.solver import DDIM
from egosim_jax.types import VideoSpec
from tests.toy_family.networks import ToyCodecConfig, ToyDenoiserConfig, ToyTextConfig

CONFIG = ModelConfig(
    name="toy",
    video=VideoSpec(frames=7, height=12, width=20, fps=8),
    dit=ToyDenoiserConfig(),
    vae=ToyCodecConfig(),
    text=ToyTextConfig(),
    image=None,
    layout=ChannelLayout(
        parts=(("noisy", 6), ("mask", 1), ("prior", 6), ("hands", 6)),
        mask_packing="single",
        mask_one="keep",
        mask_scale=0.7,
        mask_prior=False,
    ),
    tokenizer=PromptTokenizer(kind="byt5", max_tokens=16),
    process=VariancePreserving(),
    solver=DDIM(),
    steps=3,
)
