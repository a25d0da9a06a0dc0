"""The causal transformer: packed, cached and with a dense mask; gradients, FLOPs, bad input."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.models.chunks import Chunks
from egosim_jax.models.wan.dit import DiTContext
from egosim_jax.preflight.flops import count
from egosim_jax.types import InputError
from tests.flags import devices
from tests.unit.models.wan import causal_reference as reference
from tests.unit.models.wan.causal_reference import TINY, cached, dense, inputs

ROOT = Path(__file__).parents[4]
REORDERED = 1e-5
"""Relative L2 between programs that add the same float32 numbers in another order."""


@cache
def network():
    return reference.network()


def packed(dit, sizes, clean, noisy, t, *conditions):
    return dit.denoise_packed(clean, noisy, t, dit.prepare(*conditions), Chunks(sizes=sizes))


def relative(have, want):
    return np.linalg.norm(have - want) / np.linalg.norm(want)


@pytest.mark.parametrize("sizes", [(3,), (2, 1), (1, 2, 1), (2, 1, 1, 1), (1, 1, 1, 1, 1)], ids=str)
def test_packed_and_cached_chunks_are_those_of_a_dense_mask(sizes):
    graph, state = network()
    given = inputs(sum(sizes), len(sizes))

    @jax.jit
    def forms(state):
        dit = nnx.merge(graph, state)
        found = [form(dit, sizes, *given) for form in (packed, cached)]
        if len(sizes) == 1:
            _, noisy, t, *conditions = given
            found.append(dit.denoise(noisy, t[:, 0], dit.prepare(*conditions)))
        return dense(nnx.to_pure_dict(state), sizes, *given), found

    want, found = forms(state)
    start = 0
    for size in sizes:
        part = slice(start, start + size)
        for have in found:
            assert relative(have[:, part], want[:, part]) <= REORDERED
        start += size


@cache
def gradients(remat):
    sizes = 1, 2, 1
    graph, state = reference.network(replace(TINY, remat=remat or "none"))
    given = inputs(4, 3)

    def loss(state):
        if remat is None:
            return jnp.square(dense(nnx.to_pure_dict(state), sizes, *given)).mean()
        return jnp.square(packed(nnx.merge(graph, state), sizes, *given)).mean()

    return jax.tree.leaves(jax.jit(jax.grad(loss))(state))


@pytest.mark.parametrize("remat", ["none", "attention"])
def test_gradients_of_packed_chunks_are_those_of_a_dense_mask(remat):
    for have, want in zip(gradients(remat), gradients(None), strict=True):
        # A key's bias adds the same to all scores of a query: its gradient is only rounding.
        assert np.linalg.norm(have - want) <= REORDERED * max(np.linalg.norm(want), 1e-3)


def test_remat_of_all_but_attention_keeps_what_each_call_of_it_returns():
    def kept(remat):
        graph, state = reference.network(replace(TINY, remat=remat))
        loss = lambda state: packed(nnx.merge(graph, state), (1, 2), *inputs(3, 2)).sum()  # noqa: E731
        pull = jax.eval_shape(lambda state: jax.vjp(loss, state)[1], state)
        return [leaf.shape for leaf in jax.tree.leaves(pull) if leaf.ndim]

    found = kept("attention")
    for shape in kept("full"):
        found.remove(shape)
    calls = [(2, 4, 2, 4 * frames) for frames in (1, 1, 2)]  # layers, heads, batch, queries
    assert sorted(found) == sorted([(*call, size) for call in calls for size in (1, 12)])


def test_a_cache_of_another_clip_or_size_is_refused():
    graph, state = network()
    dit = nnx.merge(graph, state)
    _, noisy, t, condition, text, image = inputs(3, 1)
    later = dit.prepare_chunk(condition, dit.share(text, image), 1)
    for latents, message in (
        ((4, 4, 4), "frames 1 to 3 does not continue cached keys of the first 0 of 4"),
        ((4, 4, 6), "4 x 4 latent cells does not fit cached keys of 2 clips of 4 x 6"),
    ):
        with pytest.raises(InputError, match=message):
            dit.denoise_chunk(noisy, t[:, 0], later, dit.empty_cache(2, latents))
    first = replace(later, first_frame=0)
    with pytest.raises(InputError, match=r"frames 0 to 2 does not continue .* 0 of 2"):
        dit.denoise_chunk(noisy, t[:, 0], first, dit.empty_cache(2, (2, 4, 4)))
    with pytest.raises(InputError, match="cached keys of 1 clips"):
        dit.denoise_chunk(noisy, t[:, 0], first, dit.empty_cache(1, (3, 4, 4)))


@pytest.mark.parametrize(
    ("sizes", "message"),
    [((), "at least one chunk"), ((2, 0), r"sizes\[1\]")],
)
def test_chunks_that_do_not_make_the_clip_are_refused(sizes, message):
    with pytest.raises(InputError, match=message):
        Chunks(sizes=sizes).check(3)


@pytest.mark.parametrize("chunks", [Chunks(sizes=(1, 2, 1)), Chunks(sizes=(4,))], ids=str)
def test_the_flops_of_chunks_are_those_of_the_traced_program(chunks):
    """The trace is exact, but for products of the time embedding with the number of samples."""
    graph, state = network()
    sizes, text, image = chunks.sizes, 5, 3
    given = inputs(4, len(sizes), batch=1)
    want = TINY.packed_flops(latents=(4, 4, 4), chunks=chunks, text=text, image=image).total
    traced = jax.make_jaxpr(lambda state: packed(nnx.merge(graph, state), sizes, *given))(state)
    assert count(traced) == want

    def step(state, shared, cache):
        context = DiTContext(patches=jnp.zeros((1, 4 * sizes[-1], 48)), sources=shared,
                             rotation=jnp.ones((4 * sizes[-1], 12, 2)),
                             first_frame=chunks.bounds[-2])  # fmt: skip
        noisy = given[1][:, chunks.bounds[-2] :]
        return nnx.merge(graph, state).denoise_chunk(noisy, given[2][:, 0], context, cache)[0]

    dit = nnx.merge(graph, state)
    shared = jax.eval_shape(dit.share, *given[4:])
    cache = replace(dit.empty_cache(1, (4, 4, 4)), frames=chunks.bounds[-2])
    latents = (sizes[-1], 4, 4)
    want = TINY.chunk_flops(latents=latents, seen=chunks.bounds[-2], text=text, image=image).total
    assert count(jax.make_jaxpr(step)(state, shared, cache)) == want


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Everything that `run_causal` computes, in one program that imports jax once."""
    out = tmp_path_factory.mktemp("meshes") / "found.npz"
    command = [sys.executable, "-m", "tests.unit.models.wan.run_causal", str(out)]
    environment = os.environ | devices(8)
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "full rematerialization" not in done.stderr
    return dict(np.load(out))


@pytest.mark.slow
@pytest.mark.parametrize("context", [2, 4])
@pytest.mark.parametrize("form", ["packed", "cached", "gradients", "generated"])
def test_chunks_on_a_mesh_are_those_of_one_device(found, form, context):
    """In float32: sums are taken in another order."""
    have, want = found[f"context {context}: {form}"], found[f"alone: {form}"]
    assert relative(have, want) <= REORDERED
