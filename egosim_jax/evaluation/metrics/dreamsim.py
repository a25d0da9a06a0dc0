"""DreamSim (Fu et al. 2023): distance between images in the features of three adapted networks.

An image is resized to 224 x 224 (bicubic, with antialiasing, from uint8 to uint8) and embedded by
three ViT-B/16 networks: DINO's class token after the last block, and the projected class tokens of
CLIP and OpenCLIP. A LoRA adapts the weights of queries, keys and values. The embeddings are
concatenated and centered; the distance is one minus their cosine. This is the ensemble, the default
of the package dreamsim.

The weights come from the release v0.2.0-checkpoints (dreamsim_ensemble_checkpoint.zip, MIT),
unpacked as by the package dreamsim, with DINO's backbone where that package puts it:

    ensemble_lora/adapter_config.json and adapter_model.safetensors or .bin
    checkpoints/dino_vitbase16_pretrain.pth
    clip_vitb16_pretrain.pth.tar
    open_clip_vitb16_pretrain.pth.tar

They are read without PyTorch, and no pickle is executed.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange
from jaxtyping import Array, Float, UInt8
from PIL import Image

from egosim_jax.evaluation.metrics.batches import Batches
from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.io.digest import sha256
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.io.untrusted.pth import read_pth
from egosim_jax.types import InputError

DEFINITION = (
    "DreamSim, ensemble of release v0.2.0: frames resized to {0}x{0}, bicubic; one minus the "
    "cosine of the centered embeddings of DINO, CLIP and OpenCLIP; per frame, mean over frames; "
    "less is closer"
)
MISSING = (
    "its weights are not part of any package: unpack the release v0.2.0-checkpoints of "
    "ssundaram21/dreamsim (dreamsim_ensemble_checkpoint.zip) and give its folder. (--dreamsim)"
)
HEAD_CHANNELS = 64
"""Channels of an attention head in every ViT-B."""
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
CLIP = ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711))
"""Mean and standard deviation of the training colors."""
MAX_FRAMES = 8
"""Maximum number of frames that are embedded together."""
ADAPTED = re.compile(r"extractor_list\.(\d+)\.model\.(blocks\.\d+\.[\w.]+)\.lora_([AB])\.weight$")
"""Name of a LoRA weight: number of the network, layer, factor."""
Weights = dict[str, Array]


@dataclass(frozen=True, kw_only=True)
class Backbone:
    """One network of the ensemble: its file, and its differences from the others."""

    file: str
    """Path of the weights in the folder."""
    colors: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Mean and standard deviation of the input colors."""
    epsilon: float
    """Epsilon of the layer norms."""
    projected: bool = True
    """True if the class token is normalized and projected."""
    quick: bool = False
    """True for the activation x sigmoid(1.702 x) (QuickGELU) instead of the exact GELU."""


BACKBONES = (
    Backbone(
        file="checkpoints/dino_vitbase16_pretrain.pth",
        colors=IMAGENET,
        epsilon=1e-6,
        projected=False,
    ),
    Backbone(file="clip_vitb16_pretrain.pth.tar", colors=CLIP, epsilon=1e-5, quick=True),
    Backbone(file="open_clip_vitb16_pretrain.pth.tar", colors=CLIP, epsilon=1e-5),
)
"""Networks in the order of the ensemble."""


class DreamSim:
    """DreamSim distance between frames."""

    def __init__(self, folder: Path):
        """Read and adapt the weights. Raises `InputError` if some are missing or do not fit."""
        lora, config = _read_lora(folder)
        scale = float(config["lora_alpha"]) / float(config["r"])
        files = [folder / backbone.file for backbone in BACKBONES]
        _check_files(folder, files)
        self._weights = [
            _adapt(_read_backbone(path), lora, number, scale) for number, path in enumerate(files)
        ]
        unused = {name for number, name, _ in lora if number >= len(files)}
        if unused:
            raise InputError(
                f"The LoRA in {quote_path(folder)} adapts {quote(min(unused))} of a fourth "
                "network: only the ensemble of three is supported. Use the LoRA of release v0.2.0."
            )
        adapter = next(p for p in _adapters(folder) if p.is_file())
        self.hashes = {path.name: sha256(path) for path in (*files, adapter)}
        """SHA-256 of the weight files, by name."""

    @property
    def size(self) -> int:
        """Height and width of the networks' input in pixels."""
        weights = self._weights[0]
        places = weights["pos_embed"].shape[1] - 1
        return round(places**0.5) * weights["patch_embed.proj.weight"].shape[-1]

    def embed(self, frames: UInt8[np.ndarray, "f h w 3"]) -> Float[np.ndarray, "f d"]:
        """Return the centered embedding of each frame."""
        size = self.size
        images = np.stack(
            [
                np.asarray(Image.fromarray(frame).resize((size, size), Image.Resampling.BICUBIC))
                for frame in frames
            ]
        )
        batches = Batches(len(images), MAX_FRAMES)
        return batches.join(_embed(self._weights, batch) for batch in batches.of(images))

    def distances(
        self, a: Float[np.ndarray, "f d"], b: Float[np.ndarray, "f d"]
    ) -> Float[np.ndarray, " f"]:
        """Return the distance of each pair of embeddings."""
        norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        return 1 - (a * b).sum(axis=1) / norms


@jax.jit
def _embed(weights: list[Weights], images: UInt8[Array, "b h w 3"]) -> Float[Array, "b d"]:
    pixels = images.astype(jnp.float32) / 255
    tokens = [_forward(w, net, pixels) for w, net in zip(weights, BACKBONES, strict=True)]
    joined = jnp.concatenate(tokens, axis=-1)
    return joined - joined.mean(axis=-1, keepdims=True)


def _forward(
    weights: Weights, backbone: Backbone, images: Float[Array, "b h w 3"]
) -> Float[Array, "b d"]:
    """Return the class token of images in [0, 1]."""
    mean, deviation = (jnp.array(values) for values in backbone.colors)
    kernel = weights["patch_embed.proj.weight"]
    patches = rearrange(
        (images - mean) / deviation, "b (h p) (w q) c -> b (h w) (c p q)",
        p=kernel.shape[2], q=kernel.shape[3],
    )  # fmt: skip
    x = patches @ kernel.reshape(len(kernel), -1).T + weights["patch_embed.proj.bias"]
    first = jnp.broadcast_to(weights["cls_token"], (len(x), 1, x.shape[-1]))
    x = jnp.concatenate([first, x], axis=1) + weights["pos_embed"]
    norm = functools.partial(_norm, weights, epsilon=backbone.epsilon)
    if backbone.projected:
        x = norm("pos_drop", x)
    for number in range(_depth(weights)):
        name = f"blocks.{number}"
        x = x + _attend(weights, name, norm(f"{name}.norm1", x))
        hidden = _linear(weights, f"{name}.mlp.fc1", norm(f"{name}.norm2", x))
        active = hidden * jax.nn.sigmoid(1.702 * hidden) if backbone.quick else jax.nn.gelu(
            hidden, approximate=False
        )  # fmt: skip
        x = x + _linear(weights, f"{name}.mlp.fc2", active)
    return norm("norm", x[:, 0]) @ weights["proj"] if backbone.projected else x[:, 0]


def _attend(weights: Weights, name: str, x: Float[Array, "b n d"]) -> Float[Array, "b n d"]:
    query, key, value = rearrange(
        _linear(weights, f"{name}.attn.qkv", x), "b n (t h c) -> t b n h c", t=3, c=HEAD_CHANNELS
    )
    mixed = jax.nn.dot_product_attention(query, key, value)
    return _linear(weights, f"{name}.attn.proj", rearrange(mixed, "b n h c -> b n (h c)"))


def _linear(weights: Weights, name: str, x: Float[Array, "*b d"]) -> Float[Array, "*b e"]:
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def _norm(
    weights: Weights, name: str, x: Float[Array, "*b d"], *, epsilon: float
) -> Float[Array, "*b d"]:
    x = x - x.mean(axis=-1, keepdims=True)
    x = x / jnp.sqrt(jnp.square(x).mean(axis=-1, keepdims=True) + epsilon)
    return x * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def _depth(weights: Mapping[str, Any]) -> int:
    return 1 + max(int(name.split(".")[1]) for name in weights if name.startswith("blocks."))


def _adapters(folder: Path) -> tuple[Path, Path]:
    below = folder / "ensemble_lora"
    return below / "adapter_model.safetensors", below / "adapter_model.bin"


def _check_files(folder: Path, files: list[Path]) -> None:
    missing = [str(path.relative_to(folder)) for path in files if not path.is_file()]
    if missing:
        raise InputError(
            f"{quote_path(folder)} has no {', '.join(missing)}: DreamSim's ensemble needs them. "
            "Unpack dreamsim_ensemble_checkpoint.zip of its release v0.2.0-checkpoints there, and "
            "DINO's dino_vitbase16_pretrain.pth into checkpoints. (--dreamsim)"
        )


def _read_lora(
    folder: Path,
) -> tuple[dict[tuple[int, str, str], Float[np.ndarray, "i j"]], dict[str, Any]]:
    """Return the LoRA factors by network number, layer and factor; and the LoRA's settings."""
    config = folder / "ensemble_lora" / "adapter_config.json"
    found = [path for path in _adapters(folder) if path.is_file()]
    if not found or not config.is_file():
        _check_files(folder, [config, _adapters(folder)[0]])
    arrays = dict(_arrays(found[0]))
    factors = {}
    for name, array in arrays.items():
        match = ADAPTED.search(name)
        if match is None:
            raise InputError(
                f"{quote_path(found[0])} has {quote(name)}, which is not a LoRA factor of the "
                "ensemble. Use the LoRA of release v0.2.0."
            )
        factors[int(match[1]), match[2], match[3]] = array
    settings = read_json(config)
    for key in ("r", "lora_alpha"):
        value = settings.get(key) if isinstance(settings, dict) else None
        if not (isinstance(value, (int, float)) and 0 < value < float("inf")):
            raise InputError(
                f"{quote_path(config)} has {quote(value)} as {key}: r and lora_alpha must be "
                "positive numbers. Use the file of release v0.2.0. (--dreamsim)"
            )
    return factors, settings


def _arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    found: Mapping[str, Tensor] = (
        read_safetensors(path) if path.suffix == ".safetensors" else read_pth(path)
    )
    for name, tensor in found.items():
        yield name, np.asarray(tensor.array(), np.float32)


def _read_backbone(path: Path) -> dict[str, np.ndarray]:
    return {name.removeprefix("state_dict."): array for name, array in _arrays(path)}


def _adapt(
    weights: dict[str, np.ndarray],
    lora: Mapping[tuple[int, str, str], np.ndarray],
    number: int,
    scale: float,
) -> Weights:
    """Return a network's weights with its part of the LoRA merged in."""
    for layer in {name for index, name, _ in lora if index == number}:
        key = f"{layer}.weight"
        down, up = (lora.get((number, layer, factor)) for factor in "AB")
        if (
            down is None
            or up is None
            or down.shape[0] != up.shape[1]
            or weights.get(key, up).shape != (len(up), down.shape[1])
        ):
            raise InputError(
                f"The LoRA of DreamSim does not fit {BACKBONES[number].file}: {quote(layer)} is "
                "missing or has another size. Take both from one release. (--dreamsim)"
            )
        weights[key] = weights[key] + scale * up @ down
    return {name: jnp.asarray(array) for name, array in weights.items()}
