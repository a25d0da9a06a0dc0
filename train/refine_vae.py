"""Further training of the video VAE of given weights, optionally with a wider decoder.

A wider decoder at first computes what the narrow one does. New channels are 0 everywhere, because
no layer writes to them. Layers read them with random weights: from the first update on, gradients
reach the layers that write to them. Two operations depend on the number of channels, n instead of
m, and the weights compensate:

    RMS norm      x / sqrt(sum x^2 / n) grows by sqrt(n / m)   scale  * sqrt(m / n)
    attention     q k / sqrt(n) shrinks by sqrt(m / n)         q      * sqrt(n / m)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from egosim_jax import configs
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models import VideoCodecConfig, abstract
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.terminal import print_line
from egosim_jax.train.config import TrainConfig, WeightsDtype, resume_mutable
from egosim_jax.train.distributed import require_single_process
from egosim_jax.train.recipe import Recipe
from egosim_jax.train.task import Stage

if TYPE_CHECKING:
    from egosim_jax.train.tasks.refining import Refining

PARTS = {"qkv": 3, "time": 2}
"""Number of equal parts of a layer's output channels by its name, default 1; each part grows."""


@dataclass(frozen=True, kw_only=True)
class RefineVAE(Recipe):
    """Train the VAE of a weights folder further, all of it or its decoder.

    A decoder that is narrower than the model's is widened first, which does not change its output.
    Writes OUT/weights, with the other networks of the folder, and log and checkpoints to OUT/vae.
    """

    help_groups: ClassVar[HelpGroups] = {
        "preflight report": ("json", "search"),
        "losses and weights": (
            "part", "crop", "perceptual_weight", "perceptual_frames", "motion_weight",
            "stream_probs", "weights_dtype",
        ),
    }  # fmt: skip
    config: str
    """Name of the model."""
    vae: TrainConfig
    """Hyper-parameters of the VAE's training."""
    frames: Path | None = None
    """Folder with shards of decoded clips, `train` and `test`, as of `egosim train tabletop`."""
    weights: Path | None = None
    """Weights folder to start from."""
    part: Literal["all", "decoder"] = "all"
    """Trained part; decoder: the latents do not change.

    After a change of the encoder, train the denoiser on latents of the new encoder."""
    crop: tuple[int, int] = (48, 64)
    """Rows and columns in pixels of the training crops."""
    perceptual_weight: float = 0.1
    """Weight of LPIPS in the loss."""
    perceptual_frames: int = 4
    """Number of frames of a crop that LPIPS compares."""
    motion_weight: float = 0.0
    """Additional weight of the squared error at motion."""
    stream_probs: tuple[float, float, float] = (0.6, 0.25, 0.15)
    """Probabilities of a crop of the target, the prior and the hands."""
    weights_dtype: WeightsDtype = "float16"
    """Dtype of written weights."""

    @property
    def task(self) -> Refining:
        """The task of the training."""
        from egosim_jax.train.tasks.refining import Refining

        model = configs.get(self.config)
        return Refining(
            vae=model.vae,
            video=model.video,
            crop=self.crop,
            part=self.part,
            perceptual_weight=self.perceptual_weight,
            perceptual_frames=self.perceptual_frames,
            motion_weight=self.motion_weight,
            stream_probs=self.stream_probs,
        )

    def stages(self) -> Mapping[str, Stage]:
        """Return the training of the VAE."""
        return {"vae": Stage(self.task, self.vae)}

    def train(self) -> int:
        """Train, and write the weights. If the encoder was trained, standardize its latents."""
        out, frames, start = self.require("out", "frames", "weights")
        from egosim_jax.data.mixing import open_shards
        from egosim_jax.io.checkpoint import has_checkpoint
        from egosim_jax.io.run import open_folder
        from egosim_jax.train.loop import train
        from egosim_jax.train.tasks.autoencoding import latent_statistics

        require_single_process(self.config)
        free = [*resume_mutable("vae"), "preflight", "json", "search"]
        open_folder(out, self, mutable=free, begun=has_checkpoint(out / "vae"))
        start = widen_decoder(configs.get(self.config).vae, start, out / "start")
        vae = train(
            *self.stages()["vae"],
            data=frames / "train",
            validation=frames / "test",
            out=out / "vae",
            weights=start,
        ).vae
        if self.part == "all":
            videos = (record.arrays["target"] for record in open_shards(frames / "train"))
            vae.standardize(*latent_statistics(vae, videos))
        folder = out / "weights"
        weights.save(folder / "vae.safetensors", vae, dtype=self.weights_dtype)
        weights.add_others(folder, start)
        print_line(folder)
        return ExitCode.DONE


def widen_decoder(config: VideoCodecConfig, folder: Path, out: Path) -> Path:
    """Return a weights folder whose VAE has the config's decoder.

    It is `folder` if the decoder fits, else OUT, with the decoder widened. Raises `WeightsError` if
    more than the decoder's width differs.
    """
    file, vae = folder / "vae.safetensors", abstract(config)
    narrow = {name: tensor.array() for name, tensor in read_safetensors(file).items()}
    shapes = weights.flat_shapes(vae)
    if not weights.mismatches(narrow, shapes):
        return folder
    draw = np.random.default_rng(0)
    wider = {
        name: _widen(name, value, shapes[name], draw)
        for name, value in narrow.items()
        if name.startswith("decoder.") and value.ndim == len(shapes.get(name, ()))
    }
    weights.fill(vae, {**narrow, **wider}, dtype="float32", source=str(file))
    weights.save(out / file.name, vae)
    weights.add_others(out, folder)
    return out


def _widen(
    name: str,
    narrow: np.ndarray,
    shape: tuple[int, ...],
    draw: np.random.Generator,
) -> np.ndarray:
    """Return a parameter of the wider decoder, in float32."""
    *_, layer, kind = name.split(".")
    few, many = narrow.shape[-1], shape[-1]
    if kind == "scale":
        scale = np.ones(many, np.float32)
        scale[:few] = narrow * np.sqrt(few / many)
        return scale
    wide = np.zeros(shape, np.float32)
    parts = PARTS.get(layer, 1)
    outputs = np.arange(many).reshape(parts, -1)[:, : few // parts].ravel()
    if kind == "bias":
        wide[outputs] = narrow
    else:
        read = (*shape[:-1], few)
        wide[..., outputs] = draw.normal(size=read) / np.sqrt(np.prod(shape[:-1]))
        wide[..., : narrow.shape[-2], outputs] = narrow
    if layer == "qkv":
        wide[..., : many // parts] *= np.sqrt(many / few)
    return wide
