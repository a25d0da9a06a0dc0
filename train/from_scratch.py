"""Training from scratch: a small model's autoencoder, then its denoiser with its encoders.

    clips -> frames -> autoencoder -> latents -> denoiser and encoders -> weights

Each stage has its own folder in the run folder and resumes there. With given weights, the training
keeps their autoencoder and trains their denoiser further.
"""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.models.layers import Products
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import print_line, printable
from egosim_jax.train.config import TrainConfig, WeightsDtype, resume_mutable
from egosim_jax.train.distributed import require_single_process, stop_if_preempted
from egosim_jax.train.recipe import Recipe
from egosim_jax.train.task import Stage
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.data.clip_files import ClipFiles
    from egosim_jax.models.wan.vae import WanVAE

ENCODE_BATCH = 8
"""Batch size of the encoding."""
HELD_OUT = 8
"""Interval of held-out clips, if the metadata names none."""
OF_UPDATES = ("vae", "denoiser", "crop", "dropout", "change_loss_weight", "weights_dtype")
"""Options that only updates depend on, and not the clips or latents."""
SYNTHETIC_CLIPS = Path("clips") / "metadata.csv"
"""Metadata of the synthetic clips, in the run folder."""


@dataclass(frozen=True, kw_only=True)
class FromScratch(Recipe):
    """Train a small model from random weights: its autoencoder, its denoiser and its encoders.

    Writes OUT/weights and, next to it, the shards, logs and checkpoints of each stage.
    """

    help_groups: ClassVar[HelpGroups] = {
        "preflight report": ("json", "search"),
        "losses and weights": (
            "crop", "stride", "change_loss_weight", "weights_dtype", "products",
        ),
    }  # fmt: skip
    config: str
    """Name of a model that trains its own encoders."""
    vae: TrainConfig
    """Hyper-parameters of the autoencoder's training."""
    denoiser: TrainConfig
    """Hyper-parameters of the training of the denoiser and its encoders."""
    crop: tuple[int, int] = (48, 64)
    """Rows and columns in pixels of the autoencoder's training crops."""
    stride: int = 1
    """Frames between the starts of two training windows of a clip."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """Dropout rate of each condition of the denoiser."""
    change_loss_weight: float = 0.0
    """Additional loss weight of the denoiser where the clip differs from its prior.

    It differs at hands, at moved objects and in unobserved regions."""
    weights_dtype: WeightsDtype = "float32"
    """Dtype of written weights."""
    products: Products | None = None
    """Dtype of the factors of products in the denoiser's training; None: the model's."""
    weights: Path | None = None
    """Weights folder to start from: keep its autoencoder, train its denoiser further."""

    @abstractmethod
    def frames(self, out: Path) -> Mapping[str, Path]:
        """Write shards of decoded clips, `train` and `test`, to OUT; return their folders."""

    def stages(self) -> Mapping[str, Stage]:
        """Return the training of the denoiser and, without given weights, of the autoencoder."""
        from egosim_jax.train.tasks.autoencoding import Autoencoding
        from egosim_jax.train.tasks.denoising import Denoising

        model = self.trained_model()
        # Crops as long as the model's clips: a VAE trained on shorter crops drifts after them.
        vae = Autoencoding(vae=model.vae, video=model.video, crop=self.crop)
        denoiser = Denoising(
            model=model,
            dropout=self.dropout,
            change_loss_weight=self.change_loss_weight,
        )
        stages = {"vae": Stage(vae, self.vae), "denoiser": Stage(denoiser, self.denoiser)}
        return {name: stages[name] for name in stages if name == "denoiser" or not self.weights}

    def trained_model(self) -> ModelConfig:
        """Return the model's config with the numerics of this training.

        Raises `InputError` if its denoiser has no option `products`.
        """
        model = configs.get(self.config)
        if self.products is None:
            return model
        if "products" not in model.dit.numerics_only:
            raise InputError(
                f"The denoiser of {model.name} has no --products: omit it, instead of "
                f"{self.products}."
            )
        return replace(model, dit=replace(model.dit, products=self.products))

    def train(self) -> int:
        """Make the clips, train one stage after the other, and write the weights."""
        (out,) = self.require("out")
        check_counts({"--stride": self.stride})
        from egosim_jax.configs.model import Networks
        from egosim_jax.io.run import open_folder
        from egosim_jax.io.weights import check_trainable
        from egosim_jax.train.loop import phase0, train
        from egosim_jax.train.monitor import Samples

        require_single_process(self.config)
        if self.weights is not None:
            check_trainable(self.weights)
        has_data = any((out / made).exists() for made in ("clips", "frames", "weights"))
        open_folder(out, self, mutable=self._mutable(out), begun=has_data)
        frames = self.frames(out)
        with phase0("makes the networks"):
            networks = Networks.random(configs.get(self.config), seed=0)
        networks.vae = self._autoencoder(frames, out)
        latents = {split: self._encode(split, frames[split], out) for split in frames}
        data, validation = _join_latents(latents, out / "latents" / "joined"), latents["test"]
        trained = train(
            *self.stages()["denoiser"],
            data=data,
            validation=validation,
            out=out / "denoiser",
            weights=self.weights,
            samples=Samples(model=self.trained_model(), latents=validation, vae=out / "weights"),
        )
        networks.dit, networks.text, networks.image = trained.dit, trained.text, trained.image
        networks.save(out / "weights", dtype=self.weights_dtype)
        print_line(out / "weights")
        return ExitCode.DONE

    def _mutable(self, out: Path) -> list[str]:
        """Return the options that may change after the data: most of them before the updates."""
        from egosim_jax.io.checkpoint import has_checkpoint

        free = ["products", "preflight", "json", "search"]
        if any(has_checkpoint(out / stage) for stage in ("vae", "denoiser")):
            return [*free, *resume_mutable("vae", "denoiser")]
        return [*free, *OF_UPDATES]

    def _autoencoder(self, frames: Mapping[str, Path], out: Path) -> WanVAE:
        """Return the trained VAE, with latents of mean 0 and standard deviation 1."""
        from egosim_jax.io import weights
        from egosim_jax.models import abstract

        path = out / "weights" / "vae.safetensors"
        vae = abstract(configs.get(self.config).vae)
        if not path.exists() and self.weights is not None:
            weights.load(self.weights / path.name, vae)
            weights.save(path, vae)
        elif not path.exists():
            weights.save(path, self._train_autoencoder(frames, out), dtype=self.weights_dtype)
        # Always encode with the written, rounded weights: a resumed run has no others.
        weights.load(path, vae)
        return vae

    def _train_autoencoder(self, frames: Mapping[str, Path], out: Path) -> WanVAE:
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.train.loop import train
        from egosim_jax.train.tasks.autoencoding import latent_statistics

        vae = train(
            *self.stages()["vae"],
            data=frames["train"],
            validation=frames["test"],
            out=out / "vae",
        )
        videos = (record.arrays["target"] for record in ShardReader(frames["train"]))
        vae.standardize(*latent_statistics(vae, videos))
        return vae

    def _encode(self, split: str, frames: Path, out: Path) -> Path:
        """Encode every window of a split."""
        from egosim_jax.data.manifest import MANIFEST
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.data.transforms import video_shape
        from egosim_jax.train.encode import encode_shards

        latents, model = out / "latents" / split, configs.get(self.config)
        if not (latents / MANIFEST).exists():
            source = ShardReader(frames)
            # Validation uses a clip's first window and, if the clip is longer, its last.
            last = video_shape(source[0].arrays)[0] - model.video.frames
            encode_shards(
                model,
                out / "weights",
                source=source,
                out=latents,
                stride=self.stride if split != "test" else max(1, last),
                batch_size=ENCODE_BATCH,
                verb=f"encoding {split}",
            )
        return latents


def _join_latents(latents: Mapping[str, Path], out: Path) -> Path:
    """Return the folder of the training latents; several folders are moved into one."""
    from egosim_jax.data.manifest import MANIFEST
    from egosim_jax.data.shards import gather

    parts = [folder for split, folder in latents.items() if split != "test"]
    if len(parts) == 1:
        return parts[0]
    if not (out / MANIFEST).exists():
        out.mkdir(exist_ok=True)
        gather(parts, out)
    return out


@dataclass(frozen=True, kw_only=True)
class FromClips(FromScratch):
    """Train a small model from scratch on clips of a metadata file, or on a few synthetic ones."""

    help_groups: ClassVar[HelpGroups] = {"data": ("clip_frames",), **FromScratch.help_groups}
    metadata: Path | None = None
    """CSV or JSONL in EgoSim's columns. If no clip has the split test, every eighth is held out."""
    clips: int = 0
    """Number of synthetic tabletop clips to make instead; every fourth is held out."""
    clip_frames: int = 61
    """Number of frames of every clip; windows are cut from them."""

    def train(self) -> int:
        """Train on the clips. Raises `InputError` without metadata and synthetic clips."""
        if not self.clips:
            self.require("out", "metadata")
        return super().train()

    def frames(self, out: Path) -> Mapping[str, Path]:
        """Decode the clips of both splits at the model's size."""
        metadata = self.metadata or out / SYNTHETIC_CLIPS
        if self.metadata is None and not metadata.exists():
            self._make_clips(metadata.parent)
        return {
            "train": self._pack(metadata, "train", out),
            "test": self._pack(metadata, "test", out),
        }

    def _make_clips(self, folder: Path) -> None:
        from egosim_jax.data.clips import write_clips
        from egosim_jax.worlds.tabletop import make_sequence, to_triplet
        from egosim_jax.worlds.tabletop.dataset import conditions_of

        model = configs.get(self.config)
        spec = replace(model.video, frames=self.clip_frames)
        scenes = (next(make_sequence(seed, spec=spec)) for seed in range(self.clips))
        prior, hands = conditions_of(model)
        made = (
            to_triplet(scene, prior=prior, hands=hands, point_px=model.point_px) for scene in scenes
        )
        splits = ({"split": "test" if n % 4 == 3 else "train"} for n in range(self.clips))
        clips = (replace(clip, extra=extra) for clip, extra in zip(made, splits, strict=True))
        write_clips(folder, clips, fps=spec.fps)

    def _pack(self, metadata: Path, split: Literal["train", "test"], out: Path) -> Path:
        from egosim_jax.data.manifest import MANIFEST
        from egosim_jax.data.metadata import read_metadata
        from egosim_jax.data.pack import pack

        frames = out / "frames" / split
        if not (frames / MANIFEST).exists():
            items = select_split(read_metadata(metadata), split)
            model = configs.get(self.config)
            progress = pack(
                items,
                out=frames,
                spec=replace(model.video, frames=self.clip_frames),
                grid=model.grid,
                provenance={"metadata": str(metadata)},
            )
            try:
                for problem in track(progress, f"packing {split}", total=len(items)):
                    if problem:
                        print(printable(f"skipped: {problem}"), file=sys.stderr)
                    stop_if_preempted(out)
            except InputError as error:
                raise InputError(
                    f"{error} Training takes clips of {self.clip_frames} frames: shorter ones need "
                    "another number, 4k + 1. (--clip-frames, --metadata)"
                ) from error
        return frames


@dataclass(frozen=True, kw_only=True)
class OnAnyDevices(FromClips):
    """Check an installation: train a small model from scratch, on any number of devices.

    A batch is as large as given, or the next multiple of what the devices share.
    """

    def run(self) -> int:
        """Train with batches that the devices can share, or run the preflight."""
        if self.preflight is not None:
            return super().run()
        stages = {name: _shared(training) for name, (_, training) in self.stages().items()}
        return FromClips.run(replace(self, **stages))


def _shared(training: TrainConfig) -> TrainConfig:
    """Return a training whose batch size is rounded up to what the devices can share."""
    from egosim_jax.sharding import make_mesh, parts

    unit = parts("batch", make_mesh(training.mesh)) * training.grad_accum_steps
    return replace(training, batch_size=-(-training.batch_size // unit) * unit)


def select_split(items: Sequence[ClipFiles], split: Literal["train", "test"]) -> list[ClipFiles]:
    """Return the clips of a split, `train` or `test`.

    If the column `split` has only `train` or is missing, every eighth clip is held out; of fewer
    than eight, the last. Raises `InputError` for a single clip and for other splits.
    """
    from egosim_jax.data.metadata import select

    if {item.extra.get("split", "train") for item in items} != {"train"}:
        return select(items, where=f"split={split}")
    if len(items) < 2:
        raise InputError(
            "The metadata has one clip: validation needs another one. Annotate more videos, or cut "
            "them into shorter clips, and train on their length. (--metadata, --clip-frames)"
        )
    count = len(items)
    held_out = range(HELD_OUT - 1, count, HELD_OUT) or range(count - 1, count)
    if split == "test":
        print(f"no clip has the split test: {len(held_out)} of {count} are held out")
    return [item for n, item in enumerate(items) if (n in held_out) == (split == "test")]
