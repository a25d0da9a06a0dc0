"""Conversion table of the video transformer: Wan 2.1's official files and diffusers' model.

EgoSim and Wan 2.1 Fun InP have the official names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from einops import rearrange

from egosim_jax.conditioning.layout import WAN_INPAINT
from egosim_jax.convert.rules import Rule, linear_rules, norm_rules
from egosim_jax.convert.tables import (
    Comparison,
    Naming,
    Reader,
    Reference,
    Table,
    fewer_layers,
)
from egosim_jax.diffusion.process import RectifiedFlow
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig

PATCH_KERNEL = "o c 1 i j -> c i j o"
MODULATION = "1 k d -> k d"
TEXT_TOKENS, IMAGE_TOKENS = 512, 257
"""Numbers of tokens that diffusers' transformer expects: it splits text from image by them."""
SCHEDULER = "FlowMatchEulerDiscreteScheduler"
"""Class of the scheduler in diffusers."""


def wan(config: WanDiTConfig) -> list[Rule]:
    """Return the rules for the official state dict, for any number of input channels."""
    rules = [
        Rule("patch_embedding.weight", "patch.kernel", PATCH_KERNEL),
        Rule("patch_embedding.bias", "patch.bias"),
        *linear_rules("text_embedding.0", "text.up"),
        *linear_rules("text_embedding.2", "text.down"),
        *linear_rules("time_embedding.0", "time.mlp.up"),
        *linear_rules("time_embedding.2", "time.mlp.down"),
        *linear_rules("time_projection.1", "time.modulation"),
        Rule("blocks.*.modulation", "blocks.modulation", MODULATION),
        *norm_rules("blocks.*.norm3", "blocks.cross_norm"),
        *linear_rules("blocks.*.ffn.0", "blocks.mlp.up"),
        *linear_rules("blocks.*.ffn.2", "blocks.mlp.down"),
        Rule("head.modulation", "head.modulation", MODULATION),
        *linear_rules("head.head", "head.linear"),
    ]
    projections = {name: name for name in "qkvo"}
    for attention in ("self_attn", "cross_attn"):
        rules += _attention(f"blocks.*.{attention}", f"blocks.{attention}", projections)
    if config.image_dim is not None:
        names = ("img_emb.proj.0", "img_emb.proj.1", "img_emb.proj.3", "img_emb.proj.4")
        keys = ("k_img", "v_img", "norm_k_img")
        rules += _image(names, "blocks.*.cross_attn", keys)
    return rules


def diffusers(config: WanDiTConfig) -> list[Rule]:
    """Return the rules for the state dict of diffusers' `WanTransformer3DModel`."""
    embedder = "condition_embedder"
    rules = [
        Rule("patch_embedding.weight", "patch.kernel", PATCH_KERNEL),
        Rule("patch_embedding.bias", "patch.bias"),
        *linear_rules(f"{embedder}.text_embedder.linear_1", "text.up"),
        *linear_rules(f"{embedder}.text_embedder.linear_2", "text.down"),
        *linear_rules(f"{embedder}.time_embedder.linear_1", "time.mlp.up"),
        *linear_rules(f"{embedder}.time_embedder.linear_2", "time.mlp.down"),
        *linear_rules(f"{embedder}.time_proj", "time.modulation"),
        Rule("blocks.*.scale_shift_table", "blocks.modulation", MODULATION),
        *norm_rules("blocks.*.norm2", "blocks.cross_norm"),
        *linear_rules("blocks.*.ffn.net.0.proj", "blocks.mlp.up"),
        *linear_rules("blocks.*.ffn.net.2", "blocks.mlp.down"),
        Rule("scale_shift_table", "head.modulation", MODULATION),
        *linear_rules("proj_out", "head.linear"),
    ]
    projections = {"to_q": "q", "to_k": "k", "to_v": "v", "to_out.0": "o"}
    rules += _attention("blocks.*.attn1", "blocks.self_attn", projections)
    rules += _attention("blocks.*.attn2", "blocks.cross_attn", projections)
    if config.image_dim is not None:
        layers = ("norm1", "ff.net.0.proj", "ff.net.2", "norm2")
        names = tuple(f"{embedder}.image_embedder.{layer}" for layer in layers)
        rules += _image(names, "blocks.*.attn2", ("add_k_proj", "add_v_proj", "norm_added_k"))
    return rules


def _attention(theirs: str, ours: str, projections: Mapping[str, str]) -> list[Rule]:
    """Return the rules of an attention layer, whose queries and keys have RMS norms."""
    rules = [
        rule
        for name, own in projections.items()
        for rule in linear_rules(f"{theirs}.{name}", f"{ours}.{own}")
    ]
    norms = ("norm_q", "norm_k")
    return rules + [Rule(f"{theirs}.{name}.weight", f"{ours}.{name}.scale") for name in norms]


def _image(embedder: Sequence[str], attention: str, keys: Sequence[str]) -> list[Rule]:
    """Return the rules of the image embedder's layers, and of its keys and values."""
    (norm_in, up, down, norm_out), (k, v, norm_k) = embedder, keys
    ours = "blocks.cross_attn.image"
    return [
        *norm_rules(norm_in, "image.norm_in"),
        *linear_rules(up, "image.mlp.up"),
        *linear_rules(down, "image.mlp.down"),
        *norm_rules(norm_out, "image.norm_out"),
        *linear_rules(f"{attention}.{k}", f"{ours}.k"),
        *linear_rules(f"{attention}.{v}", f"{ours}.v"),
        Rule(f"{attention}.{norm_k}.weight", f"{ours}.norm_k.scale"),
    ]


def arguments(config: WanDiTConfig) -> dict[str, Any]:
    """Return the arguments of diffusers' `WanTransformer3DModel`."""
    return {
        "num_attention_heads": config.heads,
        "attention_head_dim": config.head_dim,
        "in_channels": config.in_channels,
        "out_channels": config.out_channels,
        "text_dim": config.text_dim,
        "freq_dim": config.freq_dim,
        "ffn_dim": config.ffn_dim,
        "num_layers": config.layers,
        "cross_attn_norm": True,
        "eps": config.eps,
        "image_dim": config.image_dim,
        "added_kv_proj_dim": config.image_dim and config.dim,
    }


def outputs(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Return both velocities of one small random clip."""
    import torch

    config, widening = comparison.config, comparison.widening
    draw = np.random.default_rng(0).standard_normal
    latents = draw((1, 2, 8, 8, config.in_channels), np.float32)
    text = draw((1, TEXT_TOKENS, config.text_dim), np.float32)
    image = config.image_dim and draw((1, IMAGE_TOKENS, config.image_dim), np.float32)
    t = np.full(1, 500, np.float32)
    have = comparison.output(latents, t, text, image)
    theirs = latents if widening is None else widening.narrow(latents)
    module = comparison.make(replace(config, in_channels=theirs.shape[-1]))
    with torch.no_grad():
        velocity = comparison.load(module)(
            torch.from_numpy(rearrange(theirs, "b f h w c -> b c f h w").copy()),
            torch.from_numpy(t),
            torch.from_numpy(text),
            None if image is None else torch.from_numpy(image),
            return_dict=False,
        )[0]
    return have, rearrange(velocity.numpy(), "b c f h w -> b f h w c")


def to_diffusers(arrays: Mapping[str, Reader], config: WanDiTConfig) -> Mapping[str, Reader]:
    """Rename official tensors by diffusers' own table."""
    from diffusers.loaders import single_file_utils

    return single_file_utils.convert_wan_transformer_to_diffusers(dict(arrays))


def pipeline(config: ModelConfig) -> dict[str, dict[str, Any]]:
    """Return the JSON files of a diffusers pipeline around the transformer.

    Raises `InputError` for a diffusion process or prediction that diffusers' scheduler lacks.
    """
    if not isinstance(config.process, RectifiedFlow):
        raise InputError(f"{SCHEDULER} has no {type(config.process).__name__}. (--layout wan)")
    if config.process.prediction != "velocity":
        raise InputError(
            f"{SCHEDULER} takes the prediction as velocity; the model predicts "
            f"{config.process.prediction}. (--layout wan)"
        )
    name = "WanPipeline" if config.image is None else "WanImageToVideoPipeline"
    parts = ("tokenizer",) if config.image is None else ("tokenizer", "image_processor")
    return {
        "model_index.json": {"_class_name": name, "scheduler": ["diffusers", SCHEDULER]}
        # They hold no weights: the caller passes them.
        | {part: [None, None] for part in parts},
        "scheduler/scheduler_config.json": {
            "_class_name": SCHEDULER,
            "shift": config.process.shift,
        },
    }


TABLE = Table(
    namings={
        "wan": Naming(
            rules=wan,
            signature="blocks.0.self_attn.q.weight",
            layout="wan",
            stem="diffusion_pytorch_model",
            lora_prefix="diffusion_model.",
            to_reference=to_diffusers,
        ),
        "diffusers": Naming(
            rules=diffusers,
            signature="condition_embedder.time_proj.weight",
            layout="diffusers",
            folder="transformer",
            stem="diffusion_pytorch_model",
        ),
    },
    reference=Reference(
        naming="diffusers",
        library="diffusers",
        kind="WanTransformer3DModel",
        arguments=arguments,
        shorten=fewer_layers,
        outputs=outputs,
    ),
    base=WAN_INPAINT,
    pipeline=pipeline,
)
"""Conversions of the video transformer; its base models are Wan 2.1's image-to-video models."""
