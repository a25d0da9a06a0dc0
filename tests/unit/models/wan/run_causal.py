"""Packed, cached and generated chunks without a mesh and on meshes of 8 devices, to OUT.npz."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from egosim_jax.generation.causal import ChunkDenoiser
from egosim_jax.models.chunks import Chunks
from egosim_jax.sharding import batch_sharding, make_mesh, shard_params
from egosim_jax.types import MeshConfig
from tests.unit.generation.test_causal import STUDENT, given, network
from tests.unit.models.wan import causal_reference as reference

SIZES, BATCH = (1, 2, 1), 4
MESHES = {"alone": None, "context 2": (1, 4, 2), "context 4": (1, 2, 4)}
"""Sizes of data, fsdp and context."""


def forms(graph, sizes):
    """Return a program of weights and inputs: packed and cached velocities, packed gradients."""

    def run(state, clean, noisy, t, *conditions):
        def loss(state):
            dit = nnx.merge(graph, state)
            context = dit.prepare(*conditions)
            packed = dit.denoise_packed(clean, noisy, t, context, Chunks(sizes=sizes))
            return jnp.square(packed).mean(), packed

        gradients, packed = jax.grad(loss, has_aux=True)(state)
        cached = reference.cached(nnx.merge(graph, state), sizes, clean, noisy, t, *conditions)
        return packed, cached, jax.tree.leaves(gradients)

    return jax.jit(run)


def main(out):
    """Compute the same with every mesh."""
    graph, state = reference.network()
    arrays = reference.inputs(sum(SIZES), len(SIZES), batch=BATCH)
    dit, clips = network(), jax.tree.map(np.asarray, given(BATCH))  # on no device yet
    found = {}
    for name, sizes in MESHES.items():
        mesh = sizes and make_mesh(MeshConfig(**dict(zip(("data", "fsdp", "context"), sizes))))  # noqa: B905
        if mesh is None:
            results = forms(graph, SIZES)(state, *arrays)
        else:
            with jax.set_mesh(mesh):
                results = forms(graph, SIZES)(
                    nnx.state(shard_params(nnx.merge(graph, state), mesh)),
                    *jax.device_put(arrays, batch_sharding(mesh)),
                )
        student = ChunkDenoiser(STUDENT, shard_params(dit, mesh), mesh)
        found[f"{name}: generated"] = np.concatenate(list(student.latents(*clips)), axis=1)
        for form, result in zip(("packed", "cached", "gradients"), results, strict=True):
            flat = [np.ravel(array) for array in jax.tree.leaves(result)]
            found[f"{name}: {form}"] = np.concatenate(flat)
    np.savez(out, **found)


if __name__ == "__main__":
    main(sys.argv[1])
