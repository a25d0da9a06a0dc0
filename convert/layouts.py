"""Which network a foreign checkpoint holds, and in whose names.

A network is told by a name that only it has; what stands before that name is the prefix of all. A
folder is searched as people download it: the EgoSim and Wan releases with their files side by side,
diffusers' with a folder a network, and the tokenizer in a folder of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from egosim_jax.convert.source import Source, sources
from egosim_jax.io.mapped import Tensor
from egosim_jax.io.untrusted import quote_path
from egosim_jax.types import InputError

Network = Literal["dit", "vae", "text", "image"]
Naming = Literal["wan", "diffusers", "transformers"]
TELLTALES: dict[tuple[Network, Naming], str] = {
    ("dit", "wan"): "blocks.0.self_attn.q.weight",
    ("dit", "diffusers"): "condition_embedder.time_proj.weight",
    ("vae", "wan"): "decoder.upsamples.0.residual.2.weight",
    ("vae", "diffusers"): "decoder.up_blocks.0.resnets.0.conv1.weight",
    ("text", "wan"): "blocks.0.ffn.gate.0.weight",
    ("text", "transformers"): "encoder.block.0.layer.0.SelfAttention.q.weight",
    ("image", "wan"): "visual.cls_embedding",
    ("image", "transformers"): "embeddings.class_embedding",
}
"""A name that every checkpoint of a network in a naming has, and no other."""
TOKENIZER = ("tokenizer.json", "spiece.model")
DEEPEST = 2
"""Folders in the folder that are searched."""
MOST_NETWORKS = 16
"""Networks in a checkpoint."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """A network in a foreign checkpoint."""

    network: Network
    naming: Naming
    prefix: str
    """What stands before every name, as `diffusion_model.` does in ComfyUI's files."""
    source: Source

    @property
    def tensors(self) -> Mapping[str, Tensor]:
        """Those of the network, without the prefix."""
        cut = len(self.prefix)
        return {
            name[cut:]: tensor
            for name, tensor in self.source.tensors.items()
            if name.startswith(self.prefix)
        }


@dataclass(frozen=True, kw_only=True)
class Folder:
    """What a file or folder holds."""

    path: Path
    found: tuple[Found, ...]
    unknown: tuple[Source, ...]
    """Checkpoints of no network of ours."""
    tokenizer: Path | None
    """The folder of the tokenizer."""

    def network(self, name: Network) -> Found:
        """The one checkpoint of a network; `InputError` if there is none or more than one."""
        here = [found for found in self.found if found.network == name]
        if len(here) != 1:
            names = ", ".join(found.source.name for found in here) or "none"
            raise InputError(
                f"{quote_path(self.path)} holds {len(here)} checkpoints of the network {name} "
                f"({names}); it takes one. Name the file itself. (--source)"
            )
        return here[0]


def recognize(path: Path) -> Folder:
    """Look through a file or folder. Raises `InputError` if it holds no checkpoint at all."""
    found, unknown, tokenizer = [], [], None
    for folder in _folders(path):
        if folder.is_dir() and any((folder / name).is_file() for name in TOKENIZER):
            tokenizer = tokenizer or folder
        for source in sources(folder):
            networks = networks_of(source)
            found += networks
            unknown += [] if networks else [source]
    if not found and not unknown:
        raise InputError(
            f"{quote_path(path)} holds no checkpoint: no .safetensors, .pth, .pt or .bin. "
            "(--source)"
        )
    return Folder(path=path, found=tuple(found), unknown=tuple(unknown), tokenizer=tokenizer)


def naming_in(layout: Literal["wan", "diffusers"], network: Network) -> Naming:
    """Whose names a network has in a layout: diffusers' takes its encoders from transformers."""
    encoder = network in ("text", "image")
    return "transformers" if encoder and layout == "diffusers" else layout


def networks_of(source: Source) -> list[Found]:
    """The networks of a checkpoint; a ComfyUI file may hold several under their prefixes."""
    found = []
    for (network, naming), telltale in TELLTALES.items():
        for name in source.tensors:
            prefix = name.removesuffix(telltale)
            if prefix != name and (not prefix or prefix.endswith(".")):
                found.append(Found(network=network, naming=naming, prefix=prefix, source=source))
    if len(found) > MOST_NETWORKS:
        raise InputError(
            f"{source.name} holds {len(found)} networks, more than the {MOST_NETWORKS} that are "
            "read from a file. Split it."
        )
    return found


def _folders(path: Path) -> list[Path]:
    """The path and the folders in it that are not hidden, the nearest first."""
    found, layer = [path], [path]
    for _ in range(DEEPEST if path.is_dir() else 0):
        layer = sorted(
            inner
            for outer in layer
            for inner in outer.iterdir()
            if inner.is_dir() and not inner.name.startswith(".")
        )
        found += layer
    return found
