"""Latents and clips of a tiny model without a mesh and on meshes of 8 devices, to FOLDER/found."""

import dataclasses
import sys
from pathlib import Path

import jax
import numpy as np

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.convert.__main__ import main as convert
from egosim_jax.diffusion import Progressive, StepCache
from egosim_jax.generation.generator import Generator
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.sharding import make_mesh
from egosim_jax.testing import random_triplet
from egosim_jax.types import InputError, MeshConfig, VideoSpec

DEBUG = configs.get("debug")
# 2 x 2 x 4 tokens and 8 heads, which eight devices divide.
CONFIG = dataclasses.replace(
    DEBUG,
    video=VideoSpec(frames=5, height=32, width=64),
    dit=WanDiTConfig(dim=64, ffn_dim=96, heads=8, layers=2, text_dim=64, image_dim=32),
    vae=dataclasses.replace(DEBUG.vae, dim_mult=(1, 1, 1, 1)),
    steps=2,
)
REUSING = dataclasses.replace(CONFIG, steps=8, cache=StepCache(threshold=0.3, first=2))
"""The same model, which reuses predictions."""
PROGRESSIVE = dataclasses.replace(
    CONFIG,
    video=VideoSpec(frames=5, height=64, width=128),
    steps=4,
    progressive=Progressive(share=0.5),
)
"""The same networks on twice the rows and columns, with steps on half of them."""
BATCH = 8
MESHES = {(4, 2, 1): BATCH, (1, 1, 8): 1}
"""Data, fsdp, context; and how many clips: as many as there is room for, and one on all devices."""


def main(folder: Path) -> None:
    """Generate the same clips everywhere."""
    networks = Networks.random(CONFIG, seed=0)
    head = networks.dit.head.linear.kernel
    head[...] = 0.1 * jax.random.normal(jax.random.key(1), head[...].shape)  # not zero
    networks.save(folder / "full")
    if convert(["quantize", str(folder / "full"), "--out", str(folder / "int8"), "--kind", "int8"]):
        raise SystemExit(1)
    triplets = [random_triplet(CONFIG.video, seed) for seed in range(BATCH)]
    larger = [random_triplet(PROGRESSIVE.video, seed) for seed in range(BATCH)]
    found = {}
    for sizes, count in {None: BATCH, **MESHES}.items():
        mesh = sizes and make_mesh(
            MeshConfig(**dict(zip(("data", "fsdp", "context"), sizes, strict=True)))
        )
        generator = Generator(CONFIG, Networks.load(CONFIG, folder / "full", mesh=mesh), mesh)
        clips = generator.generate(triplets[:count], range(count))
        reusing = Generator(REUSING, generator.networks, mesh)
        for name, model in {"latents": generator, "reused": reusing}.items():
            latents = model.latents(triplets[:count], range(count))
            found[f"{sizes} {name}"] = np.asarray(latents)
        narrow = Networks.load(CONFIG, folder / "int8", mesh=mesh)
        found[f"{sizes} int8"] = np.asarray(
            Generator(CONFIG, narrow, mesh).latents(triplets[:count], range(count))
        )
        layer = narrow.dit.blocks.mlp.down
        for name, weight in {"kernel": layer.kernel, "scale": layer.scale}.items():
            (shape,) = {shard.data.shape for shard in weight.get_value().addressable_shards}
            found[f"{sizes} shard of {name}"] = np.array(shape)
        progressive = Generator(PROGRESSIVE, generator.networks, mesh)
        latents = progressive.latents(larger[:count], range(count))
        found[f"{sizes} progressive"] = np.asarray(latents)
        found[f"{sizes} frames"] = np.stack([clip.frames for clip in clips])
    generator = Generator(CONFIG, networks, make_mesh(MeshConfig(data=4, fsdp=2)))
    try:
        generator.compile(6)
    except InputError as error:
        found["refusal"] = np.array(str(error))
    np.savez(folder / "found.npz", **found)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
