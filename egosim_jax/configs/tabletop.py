"""Model shipped with the package: small, and trained only on the tabletop world.

Trained from scratch by `egosim train tabletop`; its weights are in the package and its card
in `weights/tabletop/README.md`.
"""

from dataclasses import replace

from egosim_jax.configs.real_tiny import CONFIG as REAL_TINY

CONFIG = replace(
    REAL_TINY,
    name="tabletop",
    video=replace(REAL_TINY.video, fps=8),
    dit=replace(REAL_TINY.dit, dim=256, heads=4, layers=10),
    vae=replace(REAL_TINY.vae, decoder_dim=11, dim_mult=(1, 2, 6, 10)),
    tokenizer=replace(REAL_TINY.tokenizer, max_tokens=96),
    point_px=1,
    prior="predicted",
    steps=2,
)
