"""Names of the CLIP image encoder's weights: Wan's official file and transformers' CLIP.

Like every table: `wan` and `transformers` give the rules of a naming, `ignored` the patterns of
names, in any naming, that the network does not use.
"""

from __future__ import annotations

from egosim_jax.convert.rules import Rule
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig


def wan(config: CLIPVisionConfig) -> list[Rule]:
    """Rules for `models_clip_open-clip-xlm-roberta-large-vit-huge-14.pth`, the same for any size.

    Without the prefix `model.` that some copies of it have.
    """
    block = "visual.transformer.*"
    fused = f"{block}.attn.to_qkv"
    return [
        Rule("visual.patch_embedding.weight", "patch_embed.kernel", "conv2d"),
        Rule("visual.cls_embedding", "class_token", "1 1 d -> d"),
        Rule("visual.pos_embedding", "positions", "1 n d -> n d"),
        *_norm("visual.pre_norm", "norm"),
        *_norm(f"{block}.norm1", "blocks.norm1"),
        *(rule for i in range(3) for rule in _linear(fused, f"blocks.attn.{'qkv'[i]}", (i, 3))),
        *_linear(f"{block}.attn.proj", "blocks.attn.o"),
        *_norm(f"{block}.norm2", "blocks.norm2"),
        *_linear(f"{block}.mlp.0", "blocks.up"),
        *_linear(f"{block}.mlp.2", "blocks.down"),
    ]


def transformers(config: CLIPVisionConfig) -> list[Rule]:
    """Rules for the state dict of transformers' `CLIPVisionModel`, the same for any size.

    Without the prefix `vision_model.` that files of older versions have.
    """
    block = "encoder.layers.*"
    projections = {"q_proj": "q", "k_proj": "k", "v_proj": "v", "out_proj": "o"}
    return [
        Rule("embeddings.patch_embedding.weight", "patch_embed.kernel", "conv2d"),
        Rule("embeddings.class_embedding", "class_token"),
        Rule("embeddings.position_embedding.weight", "positions"),
        *_norm("pre_layrnorm", "norm"),
        *_norm(f"{block}.layer_norm1", "blocks.norm1"),
        *(
            rule
            for theirs, ours in projections.items()
            for rule in _linear(f"{block}.self_attn.{theirs}", f"blocks.attn.{ours}")
        ),
        *_norm(f"{block}.layer_norm2", "blocks.norm2"),
        *_linear(f"{block}.mlp.fc1", "blocks.up"),
        *_linear(f"{block}.mlp.fc2", "blocks.down"),
    ]


def ignored(config: CLIPVisionConfig) -> list[str]:
    """The text half of CLIP, what the two are compared by, and what follows our last block."""
    left_out = range(config.blocks, config.layers)
    return [
        "log_scale",
        "logit_scale",
        "textual.*",
        "text_model.*",
        "text_projection.*",
        "visual.head",
        "visual_projection.*",
        "visual.post_norm.*",
        "post_layernorm.*",
        "embeddings.position_ids",
        *(f"visual.transformer.{layer}.*" for layer in left_out),
        *(f"encoder.layers.{layer}.*" for layer in left_out),
    ]


def _linear(source: str, target: str, part: tuple[int, int] = (0, 1)) -> list[Rule]:
    return [
        Rule(f"{source}.weight", f"{target}.kernel", "linear", part),
        Rule(f"{source}.bias", f"{target}.bias", part=part),
    ]


def _norm(source: str, target: str) -> list[Rule]:
    return [
        Rule(f"{source}.weight", f"{target}.scale"),
        Rule(f"{source}.bias", f"{target}.bias"),
    ]
