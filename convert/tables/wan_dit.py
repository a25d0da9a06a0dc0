"""Conversion table of the video transformer: Wan 2.1's official files and diffusers' model.

EgoSim and Wan 2.1 Fun InP have the official names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from einops import rearrange

from egosim_jax.conditioning.layout import WAN_INPAINT
from egosim_jax.convert.rules import Rule, linear_rules, linears_rules, norm_rules
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

MODULATION = "1 k d -> k d"
TEXT_TOKENS, IMAGE_TOKENS = 512, 257
"""Numbers of tokens that diffusers' transformer expects: it splits text from image by them."""
SCHEDULER = "FlowMatchEulerDiscreteScheduler"
DIFFUSERS = {
    "text_embedding.0": "condition_embedder.text_embedder.linear_1",
    "text_embedding.2": "condition_embedder.text_embedder.linear_2",
    "time_embedding.0": "condition_embedder.time_embedder.linear_1",
    "time_embedding.2": "condition_embedder.time_embedder.linear_2",
    "time_projection.1": "condition_embedder.time_proj",
    "img_emb.proj.0": "condition_embedder.image_embedder.norm1",
    "img_emb.proj.1": "condition_embedder.image_embedder.ff.net.0.proj",
    "img_emb.proj.3": "condition_embedder.image_embedder.ff.net.2",
    "img_emb.proj.4": "condition_embedder.image_embedder.norm2",
    "blocks.*.modulation": "blocks.*.scale_shift_table",
    "blocks.*.norm3": "blocks.*.norm2",
    "blocks.*.ffn.0": "blocks.*.ffn.net.0.proj",
    "blocks.*.ffn.2": "blocks.*.ffn.net.2",
    "head.modulation": "scale_shift_table",
    "head.head": "proj_out",
}
"""Names in diffusers of layers and modulations, by the official names."""
DIFFUSERS_WORDS = {
    "self_attn": "attn1", "cross_attn": "attn2", "q": "to_q", "k": "to_k", "v": "to_v",
    "o": "to_out.0", "k_img": "add_k_proj", "v_img": "add_v_proj", "norm_k_img": "norm_added_k",
}  # fmt: skip
"""Parts of the names of attention layers in diffusers, by the official parts."""


def wan(config: WanDiTConfig) -> list[Rule]:
    """Return the rules for the official state dict, for any number of input channels."""
    rules = [
        Rule("patch_embedding.weight", "patch.kernel", "o c 1 i j -> c i j o"),
        Rule("patch_embedding.bias", "patch.bias"),
        *linears_rules("text_embedding", "text", {"0": "up", "2": "down"}),
        *linears_rules("time_embedding", "time.mlp", {"0": "up", "2": "down"}),
        *linear_rules("time_projection.1", "time.modulation"),
        Rule("blocks.*.modulation", "blocks.modulation", MODULATION),
        *norm_rules("blocks.*.norm3", "blocks.cross_norm"),
        *linears_rules("blocks.*.ffn", "blocks.mlp", {"0": "up", "2": "down"}),
        Rule("head.modulation", "head.modulation", MODULATION),
        *linear_rules("head.head", "head.linear"),
    ]
    for name in ("self_attn", "cross_attn"):
        theirs, ours = f"blocks.*.{name}", f"blocks.{name}"
        rules += linears_rules(theirs, ours, {projection: projection for projection in "qkvo"})
        rules += [Rule(f"{theirs}.norm_{x}.weight", f"{ours}.norm_{x}.scale") for x in "qk"]
    if config.image_dim is not None:
        theirs, ours = "blocks.*.cross_attn", "blocks.cross_attn.image"
        rules += [
            *norm_rules("img_emb.proj.0", "image.norm_in"),
            *linears_rules("img_emb.proj", "image.mlp", {"1": "up", "3": "down"}),
            *norm_rules("img_emb.proj.4", "image.norm_out"),
            *linears_rules(theirs, ours, {"k_img": "k", "v_img": "v"}),
            Rule(f"{theirs}.norm_k_img.weight", f"{ours}.norm_k.scale"),
        ]
    return rules


def diffusers(config: WanDiTConfig) -> list[Rule]:
    """Return the rules for the state dict of diffusers' `WanTransformer3DModel`."""
    return [replace(rule, source=_in_diffusers(rule.source)) for rule in wan(config)]


def _in_diffusers(name: str) -> str:
    """Return the name in diffusers of a tensor with an official name."""
    layer, _, kind = name.rpartition(".")
    if name in DIFFUSERS:
        return DIFFUSERS[name]
    if layer in DIFFUSERS:
        return f"{DIFFUSERS[layer]}.{kind}"
    return ".".join(DIFFUSERS_WORDS.get(word, word) for word in name.split("."))


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
