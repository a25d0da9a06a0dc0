"""Conversion table of CogVideoX's transformer: diffusers' names, which CogVideoX-Fun shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from einops import rearrange

from egosim_jax.conditioning.layout import COGVIDEOX_INPAINT
from egosim_jax.convert.rules import Rule, linear_rules, linears_rules, norm_rules
from egosim_jax.convert.tables import (
    CheckpointNaming,
    Comparison,
    Naming,
    Reference,
    Table,
    fewer_layers,
)
from egosim_jax.diffusion.process import VariancePreserving
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.cogvideox.layers import PATCH
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.io.mapped import Tensor

TEXT_TOKENS = 226
"""Text tokens of a reference forward."""
PROJECTIONS = {"to_q": "q", "to_k": "k", "to_v": "v", "to_out.0": "o"}
SCHEDULER = "CogVideoXDDIMScheduler"
PREDICTIONS = {"v": "v_prediction", "epsilon": "epsilon", "x0": "sample"}


def diffusers(config: CogVideoXDiTConfig) -> list[Rule]:
    """Return the rules for diffusers' `CogVideoXTransformer3DModel`, for any input channels."""
    theirs = "transformer_blocks.*"
    rules = [
        Rule("patch_embed.proj.weight", "patch.kernel", "o c i j -> c i j o"),
        Rule("patch_embed.proj.bias", "patch.bias"),
        *linear_rules("patch_embed.text_proj", "text"),
        *linears_rules("time_embedding", "time", {"linear_1": "up", "linear_2": "down"}),
        *_modulation(f"{theirs}.norm1", "blocks.modulation_a"),
        *_modulation(f"{theirs}.norm2", "blocks.modulation_m"),
        *linears_rules(f"{theirs}.ff.net", "blocks.mlp", {"0.proj": "up", "2": "down"}),
        *linears_rules(f"{theirs}.attn1", "blocks.attn", PROJECTIONS),
        *norm_rules("norm_final", "norm"),
        *_modulation("norm_out", "modulation"),
        *linear_rules("proj_out", "out"),
    ]
    for name in ("norm_q", "norm_k"):
        rules += norm_rules(f"{theirs}.attn1.{name}", f"blocks.attn.{name}")
    return rules


def check(tensors: Mapping[str, Tensor]) -> None:
    """Raise `InputError` for a transformer of CogVideoX 1.5, whose tokens have two frames."""
    name = "patch_embed.proj.weight"
    if name in tensors and len(tensors[name].shape) == 2:
        raise InputError(
            "This transformer is of CogVideoX 1.5, which cannot be converted: a token must have "
            f"one latent frame, and its {name} of shape {tensors[name].shape} reads two (the 13 "
            "latents of 49 frames, an odd number, would not fit either). Take version 1.1, like "
            "DWM's release: CogVideoX-Fun-V1.1-5b-InP."
        )


def arguments(config: CogVideoXDiTConfig) -> dict[str, Any]:
    """Return the arguments of diffusers' `CogVideoXTransformer3DModel`."""
    return {
        "num_attention_heads": config.heads,
        "attention_head_dim": config.head_dim,
        "in_channels": config.in_channels,
        "out_channels": config.out_channels,
        "flip_sin_to_cos": True,
        "freq_shift": 0,
        "time_embed_dim": config.time_dim,
        "text_embed_dim": config.text_dim,
        "num_layers": config.layers,
        "attention_bias": True,
        "sample_width": config.base_columns * PATCH,
        "sample_height": config.base_rows * PATCH,
        "patch_size": PATCH,
        "norm_eps": config.eps,
        "use_rotary_positional_embeddings": True,
        "use_learned_positional_embeddings": False,
    }


def outputs(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Return both predictions for one small random clip."""
    import torch
    from diffusers.models.embeddings import get_3d_rotary_pos_embed
    from diffusers.pipelines.cogvideo.pipeline_cogvideox import get_resize_crop_region_for_grid

    config, widening = comparison.config, comparison.widening
    draw = np.random.default_rng(0).standard_normal
    latents = draw((1, 3, 8, 12, config.in_channels), np.float32)
    text = draw((1, TEXT_TOKENS, config.text_dim), np.float32)
    t = np.full(1, 500, np.float32)
    have = comparison.output(latents, t, text)
    theirs = latents if widening is None else widening.narrow(latents)
    module = comparison.make(replace(config, in_channels=theirs.shape[-1]))
    _, frames, rows, columns, _ = theirs.shape
    grid = rows // PATCH, columns // PATCH
    region = get_resize_crop_region_for_grid(grid, config.base_columns, config.base_rows)
    rotary = get_3d_rotary_pos_embed(config.head_dim, region, grid, frames)
    with torch.no_grad():
        prediction = comparison.load(module)(
            torch.from_numpy(rearrange(theirs, "b f h w c -> b f c h w").copy()),
            torch.from_numpy(text),
            torch.from_numpy(t),
            image_rotary_emb=rotary,
            return_dict=False,
        )[0]
    return have, rearrange(prediction.numpy(), "b f c h w -> b f h w c")


def pipeline(config: ModelConfig) -> dict[str, dict[str, Any]]:
    """Return the JSON files of a diffusers pipeline around the transformer.

    Raises `InputError` for a diffusion process that diffusers' scheduler lacks.
    """
    process = config.process
    if not isinstance(process, VariancePreserving):
        raise InputError(f"{SCHEDULER} has no {type(process).__name__}. (--layout diffusers)")
    scheduler = {
        "_class_name": SCHEDULER,
        "num_train_timesteps": process.train_timesteps,
        "beta_start": process.beta_start,
        "beta_end": process.beta_end,
        "beta_schedule": process.beta_schedule,
        "clip_sample": False,
        "prediction_type": PREDICTIONS[process.prediction],
        "rescale_betas_zero_snr": process.zero_terminal_snr,
        "snr_shift_scale": process.snr_shift,
        "timestep_spacing": process.spacing,
    }
    return {
        "model_index.json": {
            "_class_name": "CogVideoXPipeline",
            "scheduler": ["diffusers", SCHEDULER],
            "tokenizer": [None, None],  # it holds no weights: the caller passes it
        },
        "scheduler/scheduler_config.json": scheduler,
    }


def _modulation(theirs: str, ours: str) -> list[Rule]:
    return [
        *linear_rules(f"{theirs}.linear", f"{ours}.linear"),
        *norm_rules(f"{theirs}.norm", f"{ours}.norm"),
    ]


TABLE = Table(
    namings={
        "diffusers": Naming(
            rules=diffusers,
            signature="transformer_blocks.0.norm1.linear.weight",
            layout="diffusers",
            folder="transformer",
            stem="diffusion_pytorch_model",
            lora_prefix="transformer.",
        ),
    },
    reference=Reference(
        library="diffusers",
        kind="CogVideoXTransformer3DModel",
        arguments=arguments,
        shorten=fewer_layers,
        outputs=outputs,
    ),
    check=check,
    base=COGVIDEOX_INPAINT,
    checkpoint=CheckpointNaming(naming="diffusers", stem="pytorch_lora_weights"),
    pipeline=pipeline,
)
"""Conversions of CogVideoX's transformer; its base models are CogVideoX-Fun's InP models."""
