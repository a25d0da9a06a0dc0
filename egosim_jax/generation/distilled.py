"""Samplers of step-distilled LoRAs that users share, recognized by their file's name.

Such a LoRA turns a denoiser of 50 guided steps into one of a few steps without guidance, and gives
noise or blur with any other sampler. Its file says so in its name alone.

LightX2V's LoRAs of Wan 2.1 14B (`wan2.1_i2v_lora_rank64_lightx2v_4step`, and others with
`lightx2v` and `step_distill`): timesteps 1000, 750, 500 and 250, warped by a shift of 5, no
guidance, and new noise at each step. Source: LightX2V's scheduler of step distillation and its
configuration of the I2V model, read in November 2026. LoRAs of Wan 2.2 belong to two denoisers.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion import Guidance, RectifiedFlow, Renoise

_ALL_OF = (re.compile(r"lightx2v", re.I), re.compile(r"4[-_]?steps?|step[-_]?distill", re.I))
_NONE_OF = re.compile(r"wan[-_]?2[._]?2", re.I)
STEPS, SHIFT = 4, 5.0


def distilled(config: ModelConfig, lora: Path) -> ModelConfig | None:
    """Return a model with the sampler of a step-distilled LoRA; None if it is not known as one."""
    by_name = all(text.search(lora.name) for text in _ALL_OF) and not _NONE_OF.search(lora.name)
    if not by_name or not isinstance(config.process, RectifiedFlow):
        return None
    return replace(
        config,
        steps=STEPS,
        process=replace(config.process, shift=SHIFT),
        solver=Renoise(),
        guidance=Guidance(),
    )
