"""DWM's architecture with small sizes, for static twins of the tabletop world on a CPU.

CogVideoX's networks, a VAE and a text encoder included, trained from scratch by `egosim train
dwm_tabletop`. Clips of 17 frames of 160 x 96; 10 DDIM steps, guided by the empty prompt.
"""

from egosim_jax.conditioning.layout import DWM
from egosim_jax.conditioning.text import BYT5_VOCAB, PromptTokenizer
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
    name="dwm_tabletop",
    video=VideoSpec(frames=17, height=96, width=160, fps=8),
    dit=CogVideoXDiTConfig(
        in_channels=49,
        dim=192,
        heads=3,
        layers=6,
        text_dim=64,
        time_dim=128,
        base_rows=6,
        base_columns=10,
    ),
    vae=CogVideoXVAEConfig(dims=(8, 16, 48, 80), res_blocks=1, groups=8),
    text=T5Config(vocab=BYT5_VOCAB, dim=64, ffn_dim=128, heads=2, head_dim=32, layers=2),
    image=None,
    layout=DWM,
    tokenizer=PromptTokenizer(kind="byt5", max_tokens=96),
    encoders="joint",
    process=VariancePreserving(),
    solver=DDIM(),
    guidance=Guidance(scale=1.5),
    unconditional_prompt="",
    steps=10,
)

SAMPLINGS = {
    "released": {"solver": DDIM(), "guidance": Guidance(scale=6.0), "steps": 50},
    "paper": {"solver": DPMSolver(stochastic=True), "guidance": Guidance(scale=6.0), "steps": 50},
}
"""Samplings by name: solvers, guidance and steps of the large model's."""
TRAINING = "egosim train dwm_tabletop --out runs/dwm_tabletop"
"""Command that trains the weights."""
