"""A tiny causal transformer, and the same written with a dense mask, in plain jax.numpy."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from egosim_jax.models.wan.dit import WanDiT, WanDiTConfig

TINY = WanDiTConfig(
    in_channels=7, out_channels=3, dim=48, heads=4, ffn_dim=32, layers=2, text_dim=10, image_dim=6,
    freq_dim=8,
)  # fmt: skip
CELLS = 4, 4
"""Latent rows and columns."""


def network(config=TINY):
    """Return the graph of the network and random weights, in which nothing is zero."""
    graph, state = nnx.split(nnx.eval_shape(lambda: WanDiT(config, rngs=nnx.Rngs(0))))
    rng = np.random.default_rng(0)
    draw = lambda x: jnp.asarray(0.2 * rng.standard_normal(x.shape), jnp.float32)  # noqa: E731
    return graph, jax.tree.map(draw, state)


def inputs(frames, chunks, batch=2):
    """Return clean and noisy latents, timesteps, condition, text and image."""
    rng = np.random.default_rng(1)
    latents = batch, frames, *CELLS
    shapes = [(*latents, 3), (*latents, 3), (*latents, 4), (batch, 5, 10), (batch, 3, 6)]
    clean, noisy, *others = (jnp.asarray(rng.standard_normal(s), jnp.float32) for s in shapes)
    t = jnp.asarray(rng.uniform(1, 1000, (batch, chunks)), jnp.float32)
    return clean, noisy, t, *others


def cached(dit, sizes, clean, noisy, t, condition, text, image):
    """Return the velocity of each noisy chunk, with the keys of the clean chunks before it."""
    shared = dit.share(text, image)
    cache, found, start = dit.empty_cache(len(noisy), noisy.shape[1:4]), [], 0
    for n, size in enumerate(sizes):
        part = slice(start, start + size)
        context = dit.prepare_chunk(condition[:, part], shared, start)
        found.append(dit.denoise_chunk(noisy[:, part], t[:, n], context, cache)[0])
        kept = dit.denoise_chunk(clean[:, part], jnp.zeros(len(t)), context, cache)[1]
        cache, start = cache.put(kept), start + size
    return jnp.concatenate(found, axis=1)


def dense(params, sizes, clean, noisy, t, condition, text, image):
    """Return the velocity of all noisy chunks with a dense mask over clean and noisy tokens."""
    batch, frames, rows, columns, _ = noisy.shape
    chunk = np.repeat(np.arange(len(sizes)), np.array(sizes) * rows * columns // 4)
    chunk, is_noisy = np.tile(chunk, 2), np.repeat([False, True], len(chunk))
    own = (chunk[:, None] == chunk) & (is_noisy[:, None] == is_noisy)
    mask = own | (~is_noisy & (chunk < chunk[:, None]))
    x = jnp.concatenate([clean, noisy], axis=1)
    x = jnp.concatenate([x, jnp.tile(condition, (1, 2, 1, 1, 1))], axis=-1)
    x = x.reshape(batch, 2 * frames, rows // 2, 2, columns // 2, 2, -1)
    x = jnp.einsum("bfrisjc,cijd->bfrsd", x, params["patch"]["kernel"]) + params["patch"]["bias"]
    x = x.reshape(batch, len(chunk), -1)
    time = jnp.where(is_noisy, t[:, chunk], 0)[..., None]
    angle = time * 10000.0 ** -(np.arange(4) / 4)
    time = _mlp(params["time"]["mlp"], jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1), _silu)
    six = _linear(params["time"]["modulation"], _silu(time)).reshape(*x.shape[:2], 6, -1)
    text = _mlp(params["text"], text, _gelu)
    image = _layer_norm(image, params["image"]["norm_in"], 1e-5)
    image = _mlp(params["image"]["mlp"], image, lambda y: jax.nn.gelu(y, approximate=False))
    image = _layer_norm(image, params["image"]["norm_out"], 1e-5)
    turns = np.tile(_turns(frames, rows // 2, columns // 2, 12), (2, 1))[:, None]
    for layer in range(2):
        p = jax.tree.map(lambda leaf, layer=layer: leaf[layer], params["blocks"])
        shift, scale, gate, *others = jnp.moveaxis(p["modulation"] + six, 2, 0)
        y, a = _layer_norm(x) * (1 + scale) + shift, p["self_attn"]
        q, k = (_turned(_heads(_rms(_linear(a[i], y), a[f"norm_{i}"])), turns) for i in "qk")
        x = x + gate * _linear(a["o"], _attend(q, k, _heads(_linear(a["v"], y)), mask))
        a = p["cross_attn"]
        q = _heads(_rms(_linear(a["q"], _layer_norm(x, p["cross_norm"])), a["norm_q"]))
        y = 0
        for weights, tokens in ((a, text), (a["image"], image)):
            k = _heads(_rms(_linear(weights["k"], tokens), weights["norm_k"]))
            y = y + _attend(q, k, _heads(_linear(weights["v"], tokens)), True)
        x = x + _linear(a["o"], y)
        shift, scale, gate = others
        x = x + gate * _mlp(p["mlp"], _layer_norm(x) * (1 + scale) + shift, _gelu)
    shift, scale = jnp.moveaxis(params["head"]["modulation"] + time[:, :, None], 2, 0)
    x = _linear(params["head"]["linear"], _layer_norm(x) * (1 + scale) + shift)
    x = x.reshape(batch, 2 * frames, rows // 2, columns // 2, 2, 2, 3)[:, frames:]
    return jnp.moveaxis(x, 4, 3).reshape(noisy.shape)


def _silu(x):
    return x / (1 + jnp.exp(-x))


def _gelu(x):
    return jax.nn.gelu(x, approximate=True)


def _linear(p, x):
    return x @ p["kernel"] + p["bias"]


def _mlp(p, x, activation):
    return _linear(p["down"], activation(_linear(p["up"], x)))


def _layer_norm(x, p=None, eps=1e-6):
    x = (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + eps)
    return x if p is None else x * p["scale"] + p["bias"]


def _rms(x, p):
    return x / jnp.sqrt((x**2).mean(-1, keepdims=True) + 1e-6) * p["scale"]


def _heads(x):
    return x.reshape(*x.shape[:2], 4, -1)


def _turns(frames, rows, columns, size):
    """Return a complex number of modulus 1 for each token and pair of a head."""
    side = size // 6
    angles = []
    for axis, pairs in enumerate((size // 2 - 2 * side, side, side)):
        places = np.indices((frames, rows, columns))[axis].reshape(-1, 1)
        angles.append(places * 10000.0 ** -(np.arange(pairs) / pairs))
    return np.exp(1j * np.concatenate(angles, axis=1))


def _turned(x, turns):
    pairs = (x[..., 0::2] + 1j * x[..., 1::2]) * turns
    return jnp.stack([pairs.real, pairs.imag], -1).reshape(x.shape).astype(jnp.float32)


def _attend(q, k, v, mask):
    scores = jnp.einsum("bnhk,bmhk->bhnm", q, k) / np.sqrt(q.shape[-1])
    weights = jax.nn.softmax(jnp.where(mask, scores, -jnp.inf))
    return jnp.einsum("bhnm,bmhk->bnhk", weights, v).reshape(*q.shape[:2], -1)
