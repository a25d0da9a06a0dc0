"""`egosim preflight`: compile generation for another machine and report its memory and time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import prod
from typing import TYPE_CHECKING, Any, Literal

from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError, MeshConfig, check_counts

if TYPE_CHECKING:
    from flax import nnx
    from jax.sharding import Mesh

    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.models.eight_bit import Kind
    from egosim_jax.preflight.report import OutOfMemory, Report
    from egosim_jax.preflight.targets import Target


@dataclass(frozen=True, kw_only=True)
class Preflight:
    """Compile `generate` for a machine that need not be present; report if it fits in memory.

    Prints, for encoding, denoising and decoding, or for each chunk of a causal student: memory per
    device (with the weights of all networks), FLOPs and the roofline time. Exit code 1 if a program
    does not fit.
    """

    config: str
    """Name of the model."""
    target: str
    """Machine to compile for, such as h200:1, h200:8, v5p:2x2x2 or cpu:1."""
    batch_size: int | None = None
    """Clips generated together; by default one per group of devices that share a clip."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    guidance: float | None = None
    """Scale of the guidance on the text, instead of the model's; not 1: two passes a step."""
    computed: float | None = None
    """Share of the steps that run their passes while --cache reuses the others, such as 0.4.

    The share depends on threshold and clip; `tests.benchmarks.bench_passes` counts it."""
    progressive: float | None = None
    """Run this share of the steps, the first ones, on half the rows and columns of the latents."""
    chunks: tuple[int, ...] = ()
    """Latent frames of each chunk, for a causal student of the model; by default the model's own.

    4 4 4 4 are chunks of egosim_14b."""
    first_steps: int | None = None
    """Denoising steps of the first chunk; by default as many as the other chunks have."""
    mesh: MeshConfig = field(default_factory=lambda: MeshConfig(data=-1, fsdp=1))
    """Layout of the devices; by default each generates separate clips.

    Less time for one clip: --mesh.data 1 --mesh.context -1. Weights too large for one device:
    --mesh.data 1 --mesh.fsdp -1."""
    weights_8bit: Literal["int8", "float8"] | None = None
    """Weights in 8 bits, as `egosim convert quantize` makes them."""
    activations_8bit: bool = False
    """Compute the products of 8-bit weights with 8-bit activations."""
    json: bool = False
    """Print the reports as JSON."""

    def run(self) -> int:
        """Compile the programs and print their reports."""
        from egosim_jax import configs
        from egosim_jax.io.executables import share_with_jax
        from egosim_jax.models.chunks import Chunks
        from egosim_jax.preflight import report as reports
        from egosim_jax.preflight.targets import compile_offline, find
        from egosim_jax.sharding import make_mesh, parts

        check_counts({"--batch-size": self.batch_size, "--steps": self.steps})
        compile_offline()
        share_with_jax()
        config, target = configs.get(self.config), find(self.target)
        config = self._sampling(replace(config, steps=self.steps or config.steps))
        if self.chunks:
            chunks = Chunks(sizes=self.chunks, first_steps=self.first_steps)
            config = replace(config, chunks=chunks)
        elif self.first_steps is not None:
            raise InputError("--first-steps needs chunks: give their sizes. (--chunks)")
        if self.activations_8bit:
            if self.weights_8bit is None:
                raise InputError("--activations-8bit needs weights in 8 bits. (--weights-8bit)")
            config = replace(config, activations="8bit")
        mesh = make_mesh(self.mesh, target.devices)
        size = self.batch_size or parts("batch", mesh)
        by_program = {}
        for name, report in compile_generation(
            config, target, mesh, size, weights=self.weights_8bit, computed=self.computed or 1.0
        ):
            by_program[name] = report
            if not self.json:
                text = reports.text(report)
                print(f"{name} on {target.name}, {size} clips\n\n{text}\n", flush=True)
        if self.json:
            values = {name: reports.plain(report) for name, report in by_program.items()}
            print(json.dumps(values, indent=2))
        else:
            print(_summary(by_program, size))
        fits = all(report.fits for report in by_program.values())
        return ExitCode.DONE if fits else ExitCode.FAILED

    def _sampling(self, config: ModelConfig) -> ModelConfig:
        """Return the config with the options that save or add forward passes."""
        from egosim_jax.diffusion import Guidance, Progressive, StepCache

        if self.guidance is not None:
            config = replace(config, guidance=Guidance(scale=self.guidance))
        if self.computed is not None:
            if not 0 < self.computed <= 1:
                raise InputError(
                    f"{self.computed:g} is no share of computed steps: it must be above 0 and at "
                    "most 1. (--computed)"
                )
            # Any threshold: memory and FLOPs depend on the share alone.
            config = replace(config, cache=StepCache(threshold=0.05))
        if self.progressive is not None:
            config = replace(config, progressive=Progressive(share=self.progressive))
        return config


def compile_generation(
    config: ModelConfig,
    target: Target,
    mesh: Mesh,
    size: int,
    *,
    weights: Kind | None = None,
    computed: float = 1.0,
    streamed: bool = False,
) -> Iterator[tuple[str, Report | OutOfMemory]]:
    """Yield the report of each program of generation, with the weights of all networks resident.

    `weights` is the kind of weights in 8 bits; None: all are in the compute dtype. `computed` is
    the share of the steps that a cache does not reuse. `streamed`: the programs that decode chunks.
    """
    from flax import nnx

    from egosim_jax.configs.model import Networks
    from egosim_jax.generation.generator import Generator
    from egosim_jax.io.weights import flat_shapes
    from egosim_jax.models import eight_bit
    from egosim_jax.preflight.report import compile_for

    networks = Networks.abstract(config)
    for name, network in networks.parts().items():
        stored = _stored(network, getattr(config, name).dtype)
        setattr(networks, name, stored)
        if weights is not None and name in eight_bit.NETWORKS:
            layers = dict.fromkeys(
                eight_bit.layers_of(flat_shapes(stored)), eight_bit.DTYPES[weights]
            )
            activations = name == "dit" and config.activations is not None
            eight_bit.adapt(stored, layers, activations=activations)
    generator = Generator(config, networks, mesh)
    resident = _bytes_per_device(nnx.state(generator.networks))
    for name, program, given in generator.programs(size, streamed=streamed):
        if name == "noise":  # negligible: it only fills an array of the latents' size
            continue
        traced = program.trace(*given)
        yield name, compile_for(target, traced, resident=resident, taken=computed)


def _stored(network: nnx.Module, dtype: str) -> nnx.Module:
    """Return a network with weights in its compute dtype, like converted weights."""
    import jax
    from flax import nnx

    graph, params = nnx.split(network)
    return nnx.merge(
        graph, jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype), params)
    )


def _bytes_per_device(shapes: Any) -> int:
    """Return the bytes per device of sharded arrays."""
    import jax

    return sum(
        prod(leaf.sharding.shard_shape(leaf.shape)) * leaf.dtype.itemsize
        for leaf in jax.tree.leaves(shapes)
    )


def _summary(by_name: Mapping[str, Report | OutOfMemory], size: int) -> str:
    """Return a line with the roofline time of a batch; empty if the target's speed is unknown."""
    seconds = {name: getattr(report, "roofline_s", math.nan) for name, report in by_name.items()}
    if any(map(math.isnan, seconds.values())):
        return ""
    parts = ", ".join(f"{name} {roofline:.3g}" for name, roofline in seconds.items())
    return f"{size} clips take at least {sum(seconds.values()):.3g} s: {parts}"
