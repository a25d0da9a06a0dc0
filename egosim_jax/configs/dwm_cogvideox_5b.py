"""DWM on CogVideoX-Fun V1.1 5B InP: 49 frames of 720 x 480 at 8 per second, as it was released.

The prior is the video of the static scene along the camera path, observed everywhere, and the hands
are shaded meshes on black. 50 DDIM steps with guidance away from the empty prompt; the sampling
`paper` reproduces the paper's tables. (Kim et al. 2026, Dexterous World Models.)
"""

from dataclasses import replace
from pathlib import Path

from egosim_jax.conditioning.layout import DWM
from egosim_jax.conditioning.posterior import EncodingNoise
from egosim_jax.conditioning.text import PromptTokenizer
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.dpm import DPMSolver
from egosim_jax.diffusion.guidance import Guidance
from egosim_jax.diffusion.process import VariancePreserving
from egosim_jax.diffusion.solver import DDIM
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.cogvideox.vae import CogVideoXVAEConfig
from egosim_jax.models.t5 import T5Config
from egosim_jax.types import VideoSpec

CONFIG = ModelConfig(
    name="dwm_cogvideox_5b",
    video=VideoSpec(frames=49, height=480, width=720, fps=8),
    dit=CogVideoXDiTConfig(
        in_channels=49, dtype="bfloat16", remat="attention", time_angles="float32"
    ),
    vae=CogVideoXVAEConfig(dtype="bfloat16"),
    text=T5Config(dtype="bfloat16"),
    image=None,
    layout=DWM,
    tokenizer=PromptTokenizer(kind=Path("tokenizer"), clean=False, max_tokens=226),
    posterior="sampled",
    encoding_noise=EncodingNoise(hands=True),
    process=VariancePreserving(),
    solver=DDIM(),
    guidance=Guidance(scale=6.0),
    unconditional_prompt="",
    steps=50,
)

NEGATIVE_PROMPT = (
    "The video is not of a high quality, it has a low resolution. Watermark present in each frame. "
    "The background is solid. Strange body and strange trajectory. Distortion. "
)
"""Negative prompt of the paper's evaluation, from CogVideoX-Fun's pipeline."""
SAMPLINGS = {
    "released": {
        "solver": CONFIG.solver,
        "unconditional_prompt": CONFIG.unconditional_prompt,
        "encoding_noise": CONFIG.encoding_noise,
    },
    "paper": {
        "solver": DPMSolver(stochastic=True),
        "unconditional_prompt": NEGATIVE_PROMPT,
        "encoding_noise": EncodingNoise(hands=True, prior_pixels=0.0563),
        "vae": replace(CONFIG.vae, decode_first=1),
    },
}
"""Named samplings: the release's, and the one of the scripts behind the paper's tables.

The paper uses CogVideoX-Fun's own pipeline, which adds noise to the pixels of the prior and decodes
1, 2, 2, ... latent frames at a time."""
