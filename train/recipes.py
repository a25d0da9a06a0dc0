"""Named trainings: the fields of each value are the options of `egosim-train NAME`.

docs/train.md and docs/dwm.md have the commands before and after each.
"""

from __future__ import annotations

from dataclasses import replace

from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.runtime.registry import Registry
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.fine_tuning import FineTuning
from egosim_jax.train.from_scratch import FromClips, OnAnyDevices
from egosim_jax.train.from_tabletop import FromTabletop
from egosim_jax.train.recipe import Recipe
from egosim_jax.train.refine_vae import RefineVAE
from egosim_jax.train.students import STUDENTS

_FULL = TrainConfig(
    steps=4000,
    batch_size=32,
    grad_accum_steps=4,
    optimizer=OptimizerConfig(learning_rate=1e-5, weight_decay=0.01),
    save_every=200,
    keep_every=1000,
    validate_every=200,
    sample_every=500,
)

EGOSIM_14B = FineTuning(config="egosim_14b", training=_FULL)
"""EgoSim's main training: the whole 14B transformer, from Wan 2.1 Fun InP 14B widened to 52.

AdamW at 1e-5, batch size 32, clips of 61 frames of 832 x 480, 4000 updates, as in the paper
(section 4.1). Weights and moments take 197 GB. 8 x H200 share them by FSDP: about 31 GiB each with
gradients, about 70 GiB with the activations of a clip. `--remat projections` is 5 % faster and
takes 124 GiB. 4.3e20 model FLOPs: 38 hours at 40 % of the devices' peak. Estimated, not measured;
one H200 reached 45 % with 16 of the 40 blocks (docs/gpu.md).
"""

EGOSIM_1_3B = FineTuning(config="egosim_1_3b", training=_FULL)
"""EgoSim's conditioning on the 1.3B transformer, from Wan 2.1 Fun InP 1.3B widened to 52 channels.

Weights and moments of 1.6 billion parameters take 19 GB: one H200 is enough, and eight share them.
It needs a tenth of the FLOPs of the 14B. Estimated, not measured.
"""

EGOSIM_14B_ROBOT = FineTuning(
    config="egosim_14b",
    training=replace(
        _FULL,
        steps=200,
        log_every=5,
        save_every=50,
        keep_every=None,
        validate_every=50,
        sample_every=100,
    ),
)
"""EgoSim's cross-embodiment training: from human hands to a robot's gripper.

200 updates of 32 clips after the main training, as in the paper (section 4.1). Hardware and memory
as for `egosim_14b`; two hours at 40 % of the peak. Estimated, not measured.
"""

EGOSIM_14B_FEWSHOT = FineTuning(
    config="egosim_14b",
    training=TrainConfig(
        steps=50,
        batch_size=8,
        optimizer=OptimizerConfig(learning_rate=1e-5, weight_decay=0.01),
        log_every=5,
        save_every=25,
        validate_every=25,
        sample_every=25,
    ),
)
"""EgoSim's adaptation to a new wearer or place, from a few dozen clips.

50 updates of one clip per device on 30 clips, as in the paper (section 4.1). 8 x H200 need about
62 GiB each and a few minutes; with another number of devices, set `--training.batch-size` to it.
Estimated, not measured.
"""

EGOSIM_14B_LORA = FineTuning(
    config="egosim_14b",
    rank=64,
    training=TrainConfig(
        steps=1000,
        batch_size=8,
        grad_accum_steps=8,
        optimizer=OptimizerConfig(learning_rate=1e-4, warmup_steps=20),
        save_every=100,
        validate_every=100,
        sample_every=250,
    ),
)
"""LoRA of EgoSim's 14B transformer, which one GPU can train.

    egosim-train egosim_14b_lora --weights weights/egosim_14b --latents latents/mine --out runs/lora
    egosim-convert lora runs/lora/lora.safetensors --config egosim_14b --out mine.safetensors

The frozen weights take 33 GB in bfloat16. A LoRA of rank 64 has 337 million weights; with their
moments they take 4 GB in float32. With the activations of one clip per micro-batch, 65 GiB: one
H200 or H100, a minute per update. Estimated, not measured. The second command writes the names
that ComfyUI and diffusers read.
"""

DWM_COGVIDEOX_5B = FineTuning(
    config="dwm_cogvideox_5b",
    rank=64,
    times="uniform",
    training=TrainConfig(
        steps=8000,
        batch_size=56,
        grad_accum_steps=14,
        optimizer=OptimizerConfig(
            learning_rate=1e-4,
            warmup_steps=100,
            schedule="cosine_restarts",
            weight_decay=0.01,
            b2=0.95,
        ),
        save_every=500,
        validate_every=500,
        sample_every=500,
    ),
)
"""DWM's training: a LoRA of CogVideoX-Fun V1.1 5B InP, widened from 33 to 49 channels.

AdamW (0.9, 0.95) at 1e-4 trains a LoRA of rank and alpha 64 on queries, keys, values and outputs,
and the patch projection: 66.7 million float32 weights. 56 clips of 49 frames per update, 8000
updates, as in the released checkpoint (its config asks for 15 000); no condition dropout. The
latents are drawn at each update. One H100 takes 4 clips at a time, in 57 GiB of its 75
(`--preflight h100:1`). Eight devices take 7 each; with `--training.grad-accum-steps 7`, one at a
time.
"""

DWM_WAN_14B = replace(
    DWM_COGVIDEOX_5B,
    config="dwm_wan_14b",
    max_difference=50.0,
    training=replace(
        DWM_COGVIDEOX_5B.training,
        steps=5000,
        batch_size=8,
        grad_accum_steps=8,
        optimizer=replace(DWM_COGVIDEOX_5B.training.optimizer, b2=OptimizerConfig.b2),
    ),
)
"""DWM's training on Wan 2.1 Fun V1.1 14B InP, widened from 36 to 52 channels.

It trains a LoRA of rank and alpha 64 on all 488 linear layers, and
the patch embedding; 5000 updates, as in the released checkpoint. Like its trainer, it ignores
elements whose prediction is more than 50 away from the target. One clip at a time takes 59 GiB of
an H100 (`--preflight h100:1`).
"""


def _muon(learning_rate: float, warmup_steps: int) -> OptimizerConfig:
    return OptimizerConfig(
        name="muon", learning_rate=learning_rate, warmup_steps=warmup_steps, schedule="cosine"
    )


_SMALL_VAE = TrainConfig(
    steps=4000,
    batch_size=2,
    # Long warm-up: with a short one the first updates kill the channel that separates green from
    # purple, for good.
    optimizer=_muon(1e-3, 300),
    log_every=25,
    save_every=250,
    validate_every=500,
)
_SMALL_DENOISER = replace(
    _SMALL_VAE, steps=8000, batch_size=8, optimizer=_muon(2e-3, 200), sample_every=500
)

TABLETOP = FromTabletop(
    config="tabletop",
    vae=_SMALL_VAE,
    denoiser=_SMALL_DENOISER,
    dropout=ConditionDropout(prior=0.15, mask=0.15, hands=0.15, text=0.15),
    weights_dtype="float16",
)
"""The model that comes with the package: from scratch, on clips of the tabletop world.

    egosim-train tabletop --out runs/tabletop

makes the clips, trains the VAE, encodes latents and trains the denoiser, in five hours on two CPU
cores. Every stage resumes: run the same command again after an interruption.
"""

DWM_TABLETOP = FromTabletop(
    config="dwm_tabletop",
    twins=True,
    vae=replace(_SMALL_VAE, steps=3000),
    denoiser=replace(_SMALL_DENOISER, steps=6000),
    dropout=ConditionDropout(prior=0.05, hands=0.1, text=0.1),
)
"""DWM in miniature: from scratch, on static twins of the tabletop world and meshes of its hands.

    egosim-train dwm_tabletop --out runs/dwm_tabletop

runs on a CPU, like `tabletop`; every stage resumes. `egosim experiment dwm` adapts a base model
instead.
"""

TABLETOP_VAE = RefineVAE(
    config="tabletop",
    vae=replace(_SMALL_VAE, optimizer=_muon(5e-4, 100), save_every=100),
)
r"""The VAE of `tabletop`, trained further with LPIPS in its loss.

    egosim-train tabletop_vae --frames runs/tabletop/frames --weights runs/tabletop/weights \
        --out runs/vae
    egosim-train tabletop --weights runs/vae/weights --out runs/further

The second command trains the denoiser further, on latents of the new VAE.
"""

REAL_TINY = FromClips(
    config="real_tiny",
    stride=2,
    vae=replace(
        _SMALL_VAE, steps=2000, optimizer=_muon(1e-3, 20), save_every=500, validate_every=250
    ),
    denoiser=replace(_SMALL_DENOISER, steps=2500, batch_size=4, optimizer=_muon(2e-3, 50)),
)
"""EgoSim's architecture, small, from scratch on recorded clips: the VAE, then the denoiser.

    egosim-train real_tiny --metadata CLIPS/metadata.csv --out runs/real_tiny

takes an hour on two CPU cores. Every stage resumes: run the same command again after an
interruption.
"""

_DEBUG = TrainConfig(
    steps=20,
    batch_size=2,
    optimizer=OptimizerConfig(name="muon", learning_rate=3e-3, warmup_steps=5),
    log_every=5,
    save_every=10,
    validate_every=20,
)

DEBUG = OnAnyDevices(
    config="debug",
    vae=_DEBUG,
    denoiser=replace(_DEBUG, sample_every=10),
    clips=8,
    clip_frames=25,
    stride=8,
)
"""The smallest training, on synthetic clips of the tabletop world, to check an installation.

    egosim-train debug --out runs/debug

takes minutes on two CPU cores, and on any number of devices: batches grow to a multiple of it. A
clip has three training windows of 9 frames, or two test windows.
"""

RECIPES: dict[str, tuple[str, Recipe]] = {
    "debug": ("Train `debug` for a few updates on a few synthetic clips.", DEBUG),
    "real_tiny": ("Train `real_tiny` from scratch on the clips of a metadata file.", REAL_TINY),
    "tabletop": ("Train `tabletop` from scratch on scenes of the tabletop world.", TABLETOP),
    "tabletop_vae": ("Train the VAE of `tabletop` further, with LPIPS.", TABLETOP_VAE),
    "dwm_cogvideox_5b": ("Train DWM on CogVideoX-Fun 5B, as a LoRA.", DWM_COGVIDEOX_5B),
    "dwm_wan_14b": ("Train DWM on Wan 2.1 Fun 14B, as a LoRA.", DWM_WAN_14B),
    "dwm_tabletop": ("Train DWM in miniature from scratch, on the tabletop world.", DWM_TABLETOP),
    "egosim_14b": ("Train EgoSim's 14B transformer from Wan 2.1 Fun InP.", EGOSIM_14B),
    "egosim_1_3b": ("Train the 1.3B transformer with EgoSim's conditioning.", EGOSIM_1_3B),
    "egosim_14b_robot": ("Train EgoSim's 14B transformer on clips of a robot.", EGOSIM_14B_ROBOT),
    "egosim_14b_fewshot": ("Adapt EgoSim's 14B transformer to a few clips.", EGOSIM_14B_FEWSHOT),
    "egosim_14b_lora": ("Train a LoRA of EgoSim's 14B transformer.", EGOSIM_14B_LORA),
    **STUDENTS,
}
"""Recipes by name, each with its line of the help."""


REGISTRY: Registry[Recipe] = Registry(
    "recipe",
    "--config",
    "egosim_jax.recipes",
    registered={name: recipe for name, (_, recipe) in RECIPES.items()},
)
"""Recipes of this package and of others, by name."""
get = REGISTRY.get
