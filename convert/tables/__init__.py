"""Conversion tables: the names of a network's weights in checkpoints of other projects.

A network's config names the module of its table (`config.table`), in this package or elsewhere.
The module's `TABLE` declares the namings of the network in checkpoints, the detection and file of
each naming, and the PyTorch implementation that verifies a conversion.

    Table, table_of           conversions of one kind of network
    Naming, CheckpointNaming  names of one project
    Reference, Comparison     PyTorch's network, and one forward of both
    weight_shapes             shapes of a network's weights
    pipeline_files            configs of a diffusers pipeline
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from einops import rearrange

from egosim_jax.convert.rules import Rule
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.conditioning.layout import ChannelLayout
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.convert.widen import Widening
    from egosim_jax.io.mapped import Tensor
    from egosim_jax.models import NetworkConfig

Reader = Callable[[], np.ndarray]
"""Function that reads the values of one tensor."""
SHORT_LAYERS, SHORT_VOCAB = 2, 512
"""Number of layers, and of rows of the token table, in a reference forward."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Naming:
    """Names of a network's weights in the checkpoints of one project, and their files."""

    rules: Callable[[Any], list[Rule]]
    signature: str
    """Key that every checkpoint in this naming has, and no other network."""
    layout: str
    """Layout of checkpoint folders with this naming: a value of `--layout`."""
    stem: str
    folder: str = ""
    """Folder of the file in the layout; empty if all files are side by side."""
    lora_prefix: str | None = None
    """Prefix of layer names in LoRA files; only one naming has it, and LoRAs are written in it."""
    to_reference: Callable[[Mapping[str, Reader], Any], Mapping[str, Reader] | None] | None = None
    """Renaming to the reference's names that does not use the rules; None: no such renaming."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A converted network, and the checkpoint for its PyTorch counterpart."""

    network: Any
    """Converted network in float32, of the short config."""
    config: Any
    load: Callable[..., Any]
    """Fill a PyTorch module from the checkpoint; see `verify.py`."""
    widening: Widening | None
    make: Callable[[Any], Any]
    """Make the PyTorch module of a config, to be filled by `load`; see `Reference.make`."""

    def output(self, *inputs: Any, call: Callable[..., Any] | None = None) -> np.ndarray:
        """Return the output of the network, or of `call(network, *inputs)`."""
        import jax
        from flax import nnx

        graph, params = nnx.split(self.network)
        run = call or (lambda network, *x: network(*x))
        return np.asarray(jax.jit(lambda p, *x: run(nnx.merge(graph, p), *x))(params, *inputs))


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """PyTorch implementation of a network in diffusers or transformers."""

    library: str
    """Library of the class, and naming of its parameters."""
    kind: str
    arguments: Callable[[Any], dict[str, Any]]
    """Arguments of the class, or of its config, for a network's config."""
    shorten: Callable[[Any], Any] = lambda config: replace(config, dtype="float32")
    """Float32 config with fewer layers and rows, for a quick forward."""
    outputs: Callable[[Comparison], tuple[np.ndarray, np.ndarray]]
    """Outputs of the converted network and of the PyTorch module for the same random input."""
    model_type: str | None = None
    """Name of the architecture in the configs of transformers."""

    def make(self, config: Any) -> Any:
        """Return a PyTorch module for a network's config."""
        kind = getattr(importlib.import_module(self.library), self.kind)
        arguments = self.arguments(config)
        if self.model_type is None:
            return kind(**arguments)
        return kind(kind.config_class(**arguments))

    def config_json(self, config: Any) -> dict[str, Any]:
        """Return the `config.json` that `from_pretrained` reads."""
        if self.model_type is None:
            return {"_class_name": self.kind} | self.arguments(config)
        header = {"architectures": [self.kind], "model_type": self.model_type}
        return header | self.arguments(config)


@dataclass(frozen=True, kw_only=True)
class CheckpointNaming:
    """Names of the low-rank tensors in DWM's checkpoints, which have only a LoRA."""

    naming: str
    stem: str
    prefix: str = ""
    separator: str = "."
    down: str = "lora_A.weight"
    up: str = "lora_B.weight"
    alpha: bool = False
    """True: write alpha, the rank, for each layer."""

    def tensors(self, layer: str, down: np.ndarray, up: np.ndarray) -> dict[str, np.ndarray]:
        """Return the tensors of a layer by name, for projections `[in, r]` and `[r, out]`."""
        name = f"{self.prefix}{layer.replace('.', self.separator)}"
        found = {
            f"{name}.{self.down}": np.ascontiguousarray(down.T),
            f"{name}.{self.up}": np.ascontiguousarray(up.T),
        }
        if not self.alpha:
            return found
        rank = down.shape[-1]
        alpha = np.array(rank, down.dtype)  # DWM's trainer also casts it
        exact = alpha if float(alpha) == rank else np.array(rank, np.float32)
        return {**found, f"{name}.alpha": exact}


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Conversions of one kind of network from and to other projects' checkpoints."""

    namings: Mapping[str, Naming]
    ignored: Callable[[Any], list[str]] = lambda config: []
    """Patterns of unused keys, in any naming, for a network's config."""
    reference: Reference | None = None
    """PyTorch implementation that verifies conversions."""
    base: ChannelLayout | None = None
    """Input channels of the base models for `--widen`."""
    input_layer: str = "patch"
    """Path of the layer that reads the input channels, along the first axis of its kernel."""
    checkpoint: CheckpointNaming | None = None
    """Names of the low-rank tensors in checkpoints of DWM; None for networks without."""
    check: Callable[[Mapping[str, Tensor]], None] = lambda tensors: None
    """Raise `InputError` for tensors of a similar network that cannot be converted."""
    pipeline: Callable[[ModelConfig], dict[str, dict[str, Any]]] | None = None
    """JSON files, by path, of a diffusers pipeline around this denoiser, without its networks."""

    def rules(self, naming: str, config: Any) -> list[Rule]:
        """Return the rules of a naming. Raises `InputError` if the table does not have it."""
        if naming not in self.namings:
            raise InputError(
                f"The network has no {naming} naming. Available: {', '.join(self.namings)}."
            )
        return self.namings[naming].rules(config)

    def naming_in(self, layout: str) -> str:
        """Return the naming of a layout. Raises `InputError` for an unknown layout."""
        for name, naming in self.namings.items():
            if naming.layout == layout:
                return name
        known = ", ".join(naming.layout for naming in self.namings.values())
        raise InputError(f"The network has no layout {layout}. Available: {known}. (--layout)")


def fewer_layers(config: Any) -> Any:
    """Return a float32 config with at most `SHORT_LAYERS` layers."""
    return replace(config, dtype="float32", layers=min(SHORT_LAYERS, config.layers))


def vae_outputs(comparison: Comparison, *, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return both reconstructions of a small random video."""
    import torch

    module = comparison.load(comparison.make(comparison.config))
    video = np.random.default_rng(0).uniform(-1, 1, (1, frames, 32, 32, 3)).astype(np.float32)
    have = comparison.output(video, call=lambda vae, x: vae.decode(vae.encode(x)))
    with torch.no_grad():
        theirs = torch.from_numpy(rearrange(video, "b f h w c -> b c f h w").copy())
        (posterior,) = module.encode(theirs, return_dict=False)
        (decoded,) = module.decode(posterior.mode(), return_dict=False)
    return have, rearrange(decoded.clamp(-1, 1).numpy(), "b c f h w -> b f h w c")


def table_of(config: NetworkConfig) -> Table:
    """Return the conversion table that a network's config names."""
    return importlib.import_module(config.table).TABLE


def tables_of(models: Iterable[ModelConfig]) -> list[tuple[str, Table]]:
    """Return each pair of network name and table of the models once."""
    pairs = ((n, table_of(network)) for model in models for n, network in model.networks.items())
    return list(dict.fromkeys(pairs))


@cache  # building the module takes almost a second
def weight_shapes(config: NetworkConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of every weight of a config's network by its path."""
    from egosim_jax.io.weights import flat_shapes
    from egosim_jax.models import abstract

    return flat_shapes(abstract(config))


def pipeline_files(config: ModelConfig, written: Collection[str]) -> Mapping[str, Any]:
    """Return the JSON files of a diffusers pipeline by path, with the networks in `written`.

    Empty if the denoiser's table has no pipeline.
    """
    describe = table_of(config.dit).pipeline
    if describe is None:
        return {}
    files = describe(config)
    for name, network in config.networks.items():
        table = table_of(network)
        if table.reference is None:
            continue
        reference = table.reference
        folder = table.namings[reference.library].folder
        present = name in written
        entry = [reference.library, reference.kind] if present else [None, None]
        files["model_index.json"][folder] = entry
        if present:
            files[f"{folder}/config.json"] = reference.config_json(network)
    return files
