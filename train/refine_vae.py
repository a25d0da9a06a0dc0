"""Further training of the video VAE of given weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from egosim_jax import configs
from egosim_jax.io import weights
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.terminal import print_line
from egosim_jax.train.config import TrainConfig, WeightsDtype, resume_mutable
from egosim_jax.train.distributed import require_single_process
from egosim_jax.train.recipe import Recipe
from egosim_jax.train.task import Stage

if TYPE_CHECKING:
    from egosim_jax.train.tasks.refining import Refining


@dataclass(frozen=True, kw_only=True)
class RefineVAE(Recipe):
    """Train the VAE of a weights folder further, all of it or its decoder.

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
