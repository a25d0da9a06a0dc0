"""What diffusers and transformers call the sizes of our networks, as in their `config.json`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from egosim_jax.convert.layouts import Network

if TYPE_CHECKING:
    from egosim_jax.networks import ModelConfig

FOLDERS: dict[Network, str] = {
    "dit": "transformer", "vae": "vae", "text": "text_encoder", "image": "image_encoder",
}  # fmt: skip
"""Of a network in diffusers' layout."""
CLASSES: dict[Network, tuple[str, str]] = {
    "dit": ("diffusers", "WanTransformer3DModel"),
    "vae": ("diffusers", "AutoencoderKLWan"),
    "text": ("transformers", "UMT5EncoderModel"),
    "image": ("transformers", "CLIPVisionModel"),
}
"""Library and class of a network."""


def arguments(network: Network, shape: Any) -> dict[str, Any]:
    """What their class of a network, or its config, is made with."""
    match network:
        case "dit":
            return {
                "num_attention_heads": shape.heads,
                "attention_head_dim": shape.head_dim,
                "in_channels": shape.in_channels,
                "out_channels": shape.out_channels,
                "text_dim": shape.text_dim,
                "freq_dim": shape.freq_dim,
                "ffn_dim": shape.ffn_dim,
                "num_layers": shape.layers,
                "cross_attn_norm": True,
                "eps": shape.eps,
                "image_dim": shape.image_dim,
                "added_kv_proj_dim": shape.image_dim and shape.dim,
            }
        case "vae":
            return {
                "base_dim": shape.dim,
                "z_dim": shape.z_dim,
                "dim_mult": list(shape.dim_mult),
                "num_res_blocks": shape.res_blocks,
                "temperal_downsample": list(shape.temporal_downsample),
                "latents_mean": list(shape.latent_mean),
                "latents_std": list(shape.latent_std),
            }
        case "text":
            return {
                "vocab_size": shape.vocab,
                "d_model": shape.dim,
                "d_kv": shape.head_dim,
                "d_ff": shape.ffn_dim,
                "num_layers": shape.layers,
                "num_heads": shape.heads,
                "relative_attention_num_buckets": shape.buckets,
                "relative_attention_max_distance": shape.max_distance,
                "layer_norm_epsilon": shape.eps,
                "feed_forward_proj": "gated-gelu",
            }
        case "image":
            return {
                "hidden_size": shape.dim,
                "intermediate_size": shape.ffn_dim,
                "num_hidden_layers": shape.layers,
                "num_attention_heads": shape.heads,
                "image_size": shape.image_size,
                "patch_size": shape.patch,
                "layer_norm_eps": shape.eps,
                "hidden_act": "gelu",
            }


def pipeline(config: ModelConfig, networks: Collection[Network]) -> Mapping[str, Any]:
    """The JSON files, by path, that make a folder of these networks a pipeline of diffusers."""
    name = "WanPipeline" if config.image is None else "WanImageToVideoPipeline"
    files: dict[str, Any] = {}
    index: dict[str, Any] = {"_class_name": name, "scheduler": ["diffusers", SCHEDULER]}
    for network, folder in FOLDERS.items():
        library, kind = CLASSES[network]
        if network in networks:
            index[folder] = [library, kind]
            own = arguments(network, getattr(config, network))
            files[f"{folder}/config.json"] = KINDS.get(network, {"_class_name": kind}) | own
        elif network != "image" or config.image is not None:
            index[folder] = [None, None]
    left = ("tokenizer",) if config.image is None else ("tokenizer", "image_processor")
    index |= {part: [None, None] for part in left}  # they hold no weights: the caller gives them
    scheduler = {"_class_name": SCHEDULER, "shift": config.process.shift}
    return files | {"scheduler/scheduler_config.json": scheduler, "model_index.json": index}


SCHEDULER = "FlowMatchEulerDiscreteScheduler"
KINDS: dict[Network, dict[str, Any]] = {
    "text": {"architectures": ["UMT5EncoderModel"], "model_type": "umt5"},
    "image": {"architectures": ["CLIPVisionModel"], "model_type": "clip_vision_model"},
}
"""How transformers' configs say what they are of; diffusers' name the class."""
