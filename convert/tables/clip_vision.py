"""Conversion table of the CLIP image encoder: Wan's official file and transformers' CLIP."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from einops import rearrange

from egosim_jax.convert.rules import Rule, linear_rules, linears_rules, norm_rules
from egosim_jax.convert.tables import SHORT_LAYERS, Comparison, Naming, Reference, Table
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig

STACKS = ("visual.transformer", "encoder.layers")
"""Names of the stack of blocks in both namings."""


def wan(config: CLIPVisionConfig) -> list[Rule]:
    """Return the rules for `models_clip_open-clip-xlm-roberta-large-vit-huge-14.pth`.

    They are the same for any size, and without the prefix `model.` of some copies.
    """
    block = "visual.transformer.*"
    fused = f"{block}.attn.to_qkv"
    return [
        Rule("visual.patch_embedding.weight", "patch_embed.kernel", "conv2d"),
        Rule("visual.cls_embedding", "class_token", "1 1 d -> d"),
        Rule("visual.pos_embedding", "positions", "1 n d -> n d"),
        *norm_rules("visual.pre_norm", "norm"),
        *norm_rules(f"{block}.norm1", "blocks.norm1"),
        *(
            rule
            for i in range(3)
            for rule in linear_rules(fused, f"blocks.attn.{'qkv'[i]}", (i, 3))
        ),
        *linear_rules(f"{block}.attn.proj", "blocks.attn.o"),
        *norm_rules(f"{block}.norm2", "blocks.norm2"),
        *linears_rules(f"{block}.mlp", "blocks", {"0": "up", "2": "down"}),
    ]


def transformers(config: CLIPVisionConfig) -> list[Rule]:
    """Return the rules for the state dict of transformers' `CLIPVisionModel`.

    They are the same for any size, and without the prefix `vision_model.` of older versions.
    """
    block = "encoder.layers.*"
    projections = {"q_proj": "q", "k_proj": "k", "v_proj": "v", "out_proj": "o"}
    return [
        Rule("embeddings.patch_embedding.weight", "patch_embed.kernel", "conv2d"),
        Rule("embeddings.class_embedding", "class_token"),
        Rule("embeddings.position_embedding.weight", "positions"),
        *norm_rules("pre_layrnorm", "norm"),
        *norm_rules(f"{block}.layer_norm1", "blocks.norm1"),
        *linears_rules(f"{block}.self_attn", "blocks.attn", projections),
        *norm_rules(f"{block}.layer_norm2", "blocks.norm2"),
        *linears_rules(f"{block}.mlp", "blocks", {"fc1": "up", "fc2": "down"}),
    ]


def ignored(config: CLIPVisionConfig) -> list[str]:
    """Return the keys of CLIP's text encoder, its projections and the last, unused blocks."""
    unused = range(config.blocks, config.layers)
    return [
        "log_scale", "logit_scale", "textual.*", "text_model.*", "text_projection.*", "visual.head",
        "visual_projection.*", "visual.post_norm.*", "post_layernorm.*", "embeddings.position_ids",
        *(f"{stack}.{layer}.*" for stack in STACKS for layer in unused),
    ]  # fmt: skip


def arguments(config: CLIPVisionConfig) -> dict[str, Any]:
    """Return the arguments of transformers' `CLIPVisionConfig`."""
    return {
        "hidden_size": config.dim,
        "intermediate_size": config.ffn_dim,
        "num_hidden_layers": config.layers,
        "num_attention_heads": config.heads,
        "image_size": config.image_size,
        "patch_size": config.patch,
        "layer_norm_eps": config.eps,
        "hidden_act": "gelu",
    }


def shorten(config: CLIPVisionConfig) -> CLIPVisionConfig:
    """Return a float32 config with fewer blocks, and none unused."""
    layers = min(SHORT_LAYERS, config.blocks)
    return replace(config, dtype="float32", layers=layers, skip_last=0)


def outputs(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Return both token grids of a random image."""
    import torch

    config = comparison.config
    size = (1, config.image_size, config.image_size, 3)
    pixels = np.random.default_rng(0).standard_normal(size, np.float32)
    have = comparison.output(pixels)
    module = comparison.load(
        comparison.make(config), prefix="vision_model.", unused="post_layernorm"
    )
    with torch.no_grad():
        theirs = torch.from_numpy(rearrange(pixels, "b h w c -> b c h w").copy())
        states = module(theirs, output_hidden_states=True)
    return have, states.hidden_states[-1].numpy()


TABLE = Table(
    namings={
        "wan": Naming(
            rules=wan,
            signature="visual.cls_embedding",
            layout="wan",
            stem="models_clip_open-clip-xlm-roberta-large-vit-huge-14",
        ),
        "transformers": Naming(
            rules=transformers,
            signature="embeddings.class_embedding",
            layout="diffusers",
            folder="image_encoder",
            stem="model",
        ),
    },
    ignored=ignored,
    reference=Reference(
        library="transformers",
        kind="CLIPVisionModel",
        arguments=arguments,
        shorten=shorten,
        outputs=outputs,
        model_type="clip_vision_model",
    ),
)
