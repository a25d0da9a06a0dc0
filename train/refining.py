"""Refining: the video VAE of given weights, trained further on decoded clips."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from egosim_jax import configs
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.train.config import TrainConfig, WeightsDtype, resume_mutable
from egosim_jax.train.distributed import require_single_process
from egosim_jax.train.recipe_base import Recipe
from egosim_jax.train.update import Stage

if TYPE_CHECKING:
    from egosim_jax.train.tasks.refining import Refining


@dataclass(frozen=True, kw_only=True)
class RefineVAE(Recipe):
    """Train the VAE of a weights folder further, all of it or its decoder.

    A decoder that is narrower than the model's is widened first, without changing what it decodes.
    Writes OUT/weights, with the other networks of the folder, and log and checkpoints in OUT/vae.
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
    """Folder with shards of decoded clips, `train` and `test`, as `egosim train tabletop` makes."""
    weights: Path | None = None
    """Weights folder to start from."""
    part: Literal["all", "decoder"] = "all"
    """Weights that are trained; decoder: the latents stay as they are.

    After a change of the encoder a denoiser must be trained on latents of the new one."""
    crop: tuple[int, int] = (48, 64)
    """Rows and columns in pixels of the crops that the VAE is trained on."""
    perceptual_weight: float = 0.1
    """Weight of LPIPS in the loss."""
    perceptual_frames: int = 4
    """Frames of a crop that LPIPS compares."""
    motion_weight: float = 0.0
    """Additional weight of the squared error where something moves."""
    stream_probs: tuple[float, float, float] = (0.6, 0.25, 0.15)
    """Probabilities that a crop is of the target, the prior and the hands."""
    weights_dtype: WeightsDtype = "float16"
    """Dtype of the weights that are written."""

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
        """Train, and write the weights. An encoder that changed gives standardized latents."""
        out, frames, start = self.require("out", "frames", "weights")
        from egosim_jax.data.mixing import open_shards
        from egosim_jax.io import weights
        from egosim_jax.io.run import open_folder
        from egosim_jax.train.loop import train
        from egosim_jax.train.tasks.autoencoding import latent_statistics
        from egosim_jax.train.wider import with_decoder_of

        require_single_process(self.config)
        open_folder(out, self, mutable=[*resume_mutable("vae"), "preflight", "json", "search"])
        start = with_decoder_of(configs.get(self.config).vae, start, out / "start")
        vae = train(
            *self.stages()["vae"],
            data=frames / "train",
            validation=frames / "test",
            out=out / "vae",
            weights=start,
            run_folder=out,
        ).vae
        if self.part == "all":
            videos = (record.arrays["target"] for record in open_shards(frames / "train"))
            vae.standardize(*latent_statistics(vae, videos))
        folder = out / "weights"
        weights.save(folder / "vae.safetensors", vae, dtype=self.weights_dtype)
        weights.link_others(folder, start)
        print(folder)
        return ExitCode.DONE
