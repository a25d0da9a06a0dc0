"""Recipes of causal students: three stages for each of three models.

    student_ar     teacher forcing: each chunk from the clean chunks before it
    student_cd     consistency distillation: few steps
    student_dmd    self-forcing: own clips, regression and distribution matching

The rates and numbers of updates of EgoSim's stages follow Casual-EgoSim's configs. Costs are
estimates: the preflight's FLOPs at 40 % of the devices' peak. docs/streaming.md has the commands,
also for LoRAs on one H200.
"""

from __future__ import annotations

from dataclasses import replace

from egosim_jax.train.config import CriticConfig, OptimizerConfig, TrainConfig
from egosim_jax.train.distillation import ConsistencyDistillation, SelfForcing
from egosim_jax.train.fine_tuning import FineTuning
from egosim_jax.train.recipe import Recipe
from egosim_jax.types import MeshConfig

_ADAM = OptimizerConfig(learning_rate=2e-6, b1=0.0, weight_decay=0.01)
_AR = TrainConfig(
    steps=1000,
    batch_size=32,
    grad_accum_steps=4,
    optimizer=_ADAM,
    save_every=100,
    keep_every=500,
    validate_every=100,
    sample_every=250,
)
_CD = replace(_AR, optimizer=replace(_ADAM, ema_decay=0.99))
# 120 updates of the student are 600 of the critic, Casual-EgoSim's number.
_DMD = replace(_CD, steps=120, save_every=20, keep_every=40, validate_every=20, sample_every=20)
_CRITIC = CriticConfig(optimizer=replace(_ADAM, learning_rate=4e-7))
_CHUNKS = (4, 4, 4, 4)
_CHANGE = 4.0
"""Loss weight of hands and moved objects, which a student blurs first."""

EGOSIM_14B_AR = FineTuning(config="egosim_14b", chunks=_CHUNKS, training=_AR)
"""Teacher forcing of EgoSim's 14B transformer, chunks of 4 latent frames.

All weights on 8 x H200. 1000 updates of 32 clips are 6.3e20 model FLOPs: 56 hours at 40 % of the
peak. Estimated, not measured.
"""

EGOSIM_14B_CD = ConsistencyDistillation(
    config="egosim_14b", chunks=_CHUNKS, training=_CD, change_loss_weight=_CHANGE
)
"""Consistency distillation of the student of `egosim_14b_student_ar`, which is its teacher.

Student, moving average and teacher are three copies of the weights on 8 x H200.
"""

EGOSIM_14B_DMD = SelfForcing(
    config="egosim_14b",
    chunks=_CHUNKS,
    first_steps=4,
    # The keys and values of all chunks stay for the gradient: two devices share a clip.
    training=replace(_DMD, grad_accum_steps=8, mesh=MeshConfig(context=2)),
    critic=_CRITIC,
    change_loss_weight=_CHANGE,
)
"""Self-forcing of the student of `egosim_14b_student_cd`, with EgoSim-14B as teacher.

120 updates of the student, each after five of the critic. On 8 x H200, two devices share a clip:
125.5 of 133.3 GiB (`--preflight h200:8`). Four denoising steps of the first chunk
and two of the others, whose last keys later chunks see. Stop when LPIPS of held-out clips no longer
falls (`egosim generate` with the kept checkpoints, `egosim evaluate`). On one H200, three LoRAs
share one frozen base. They take 124.5 GiB, and an update has 1.0e18 model FLOPs (`--preflight
h200:1`): 120 updates are 86 hours at 40 % of the peak. Estimated, not measured.
"""

EGOSIM_1_3B_AR = replace(EGOSIM_14B_AR, config="egosim_1_3b")
"""Teacher forcing of the 1.3B transformer, as `egosim_14b_student_ar`: one H200, all weights."""

EGOSIM_1_3B_CD = replace(EGOSIM_14B_CD, config="egosim_1_3b")
"""Consistency distillation of the 1.3B student, as `egosim_14b_student_cd`: one H200."""

EGOSIM_1_3B_DMD = replace(EGOSIM_14B_DMD, config="egosim_1_3b", training=_DMD)
"""Self-forcing of the 1.3B student, as `egosim_14b_student_dmd`: one H200."""

_SMALL = TrainConfig(
    steps=1200,
    batch_size=4,
    optimizer=OptimizerConfig(
        learning_rate=1e-3, warmup_steps=20, schedule="cosine", ema_decay=0.98
    ),
    save_every=50,
    validate_every=100,
)

TABLETOP_AR = FineTuning(
    config="tabletop",
    chunks=(1, 2, 2),
    rank=64,
    times="uniform",
    sampler_steps=2,
    products="bfloat16",
    change_loss_weight=2.0,
    training=_SMALL,
)
"""Teacher forcing of `tabletop` as a LoRA, on latents of `egosim-train tabletop` and a CPU core.

Half of the noise levels are those that a sampler of two steps visits.
"""

TABLETOP_CD = ConsistencyDistillation(
    config="tabletop",
    chunks=(1, 2, 2),
    rank=64,
    products="bfloat16",
    change_loss_weight=2.0,
    training=_SMALL,
)
"""Consistency distillation of the student of `tabletop_student_ar`."""

TABLETOP_DMD = SelfForcing(
    config="tabletop",
    chunks=(1, 2, 2),
    rank=64,
    products="bfloat16",
    change_loss_weight=2.0,
    matching=0.0,
    regression=1.0,
    training=_SMALL,
    critic=CriticConfig(optimizer=OptimizerConfig(learning_rate=2e-4)),
)
"""Self-forcing of a student of `tabletop`, by regression alone.

It needs no earlier stage. `--matching 1 --regression 0.25` adds teacher and critic.
"""

STUDENTS: dict[str, tuple[str, Recipe]] = {
    "tabletop_student_ar": ("Teacher forcing of a student of `tabletop`.", TABLETOP_AR),
    "tabletop_student_cd": ("Consistency distillation of a student of `tabletop`.", TABLETOP_CD),
    "tabletop_student_dmd": ("Train a student of `tabletop` on its own clips.", TABLETOP_DMD),
    "egosim_1_3b_student_ar": ("Teacher forcing of a student, 1.3B.", EGOSIM_1_3B_AR),
    "egosim_1_3b_student_cd": ("Consistency distillation of a student, 1.3B.", EGOSIM_1_3B_CD),
    "egosim_1_3b_student_dmd": ("Train a student on its own clips, 1.3B.", EGOSIM_1_3B_DMD),
    "egosim_14b_student_ar": ("Teacher forcing of a student, 14B.", EGOSIM_14B_AR),
    "egosim_14b_student_cd": ("Consistency distillation of a student, 14B.", EGOSIM_14B_CD),
    "egosim_14b_student_dmd": ("Train a student on its own clips, 14B.", EGOSIM_14B_DMD),
}
"""Recipes by name, each with its line of the help."""
