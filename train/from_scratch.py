"""Training from scratch: a small model's autoencoder, then its denoiser with its encoders.

    clips -> frames -> autoencoder -> latents -> denoiser and encoders -> weights

Each stage has its own folder in the run folder, and resumes. With given weights the autoencoder is
theirs and the denoiser is trained further.
"""

from __future__ import annotations

import os
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
from egosim_jax.train.config import TrainConfig, WeightsDtype, resume_mutable
from egosim_jax.train.distributed import require_single_process, stop_if_preempted
from egosim_jax.train.recipe_base import Recipe
from egosim_jax.train.update import Stage
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.data.clip_files import ClipFiles
    from egosim_jax.models.wan.vae import WanVAE

ENCODE_BATCH = 8
"""Clips that are encoded together."""
HELD_OUT = 8
"""Number of clips of which one validates, in metadata that names none for it."""
SYNTHETIC_CLIPS = Path("clips") / "metadata.csv"
"""Metadata of the synthetic clips, in the run folder."""
FIRST_TRAINED = 1000
"""Seed of the first tabletop scene to train on; those below are held out."""


@dataclass(frozen=True, kw_only=True)
class FromScratch(Recipe):
    """Train a small model from random weights: its autoencoder, its denoiser and its encoders.

    Writes OUT/weights, with the shards, logs and checkpoints of each stage next to it.
    """

    help_groups: ClassVar[HelpGroups] = {
        "preflight report": ("json", "search"),
        "losses and weights": (
            "crop", "stride", "change_loss_weight", "weights_dtype", "products", "bundle",
        ),
    }  # fmt: skip
    config: str
    """Name of the model, which must train its own encoders."""
    vae: TrainConfig
    """Hyper-parameters of the autoencoder's training."""
    denoiser: TrainConfig
    """Hyper-parameters of the training of the denoiser and its encoders."""
    crop: tuple[int, int] = (48, 64)
    """Rows and columns in pixels of the crops that the autoencoder is trained on."""
    stride: int = 1
    """Frames between the windows of a clip that the denoiser is trained on."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """Dropout rate of each condition of the denoiser."""
    change_loss_weight: float = 0.0
    """Additional loss weight of the denoiser where the clip differs from its prior.

    It differs at hands, at what they move and in unobserved regions."""
    weights_dtype: WeightsDtype = "float32"
    """Dtype of the weights that are written."""
    products: Products | None = None
    """Dtype to which the denoiser's training rounds the factors of products; None: the model's."""
    weights: Path | None = None
    """Weights folder to start from: its autoencoder is kept, its denoiser is trained further."""
    bundle: Path | None = None
    """Write code, latents and weights to this new folder, to train the denoiser elsewhere.

    `train/bundled.py` trains there, where little is installed. Starts from the weights that come
    with the package, if it has some; clips and latents are kept in OUT, by default BUNDLE_data."""

    @abstractmethod
    def frames(self, out: Path) -> Mapping[str, Path]:
        """Make shards of decoded clips, `train` and `test`, in OUT, and return their folders."""

    def stages(self) -> Mapping[str, Stage]:
        """Return the training of the denoiser, and that of the autoencoder unless it is given."""
        from egosim_jax.train.tasks.autoencoding import Autoencoding
        from egosim_jax.train.tasks.denoising import Denoising

        model = self.trained_model()
        # Crops as long as the model's clips: a VAE trained on shorter ones drifts afterwards.
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
                f"The denoiser of {model.name} has no --products, which must be omitted, not "
                f"{self.products}."
            )
        return replace(model, dit=replace(model.dit, products=self.products))

    def train(self) -> int:
        """Make the clips, train stage after stage, and write the weights, or a bundle."""
        if self.bundle is not None and (given := self._for_bundle(self.bundle)) != self:
            return given.train()
        (out,) = self.require("out")
        check_counts({"--stride": self.stride})
        from egosim_jax.configs.model import Networks
        from egosim_jax.io.run import open_folder
        from egosim_jax.train.loop import train
        from egosim_jax.train.monitor import Samples

        require_single_process(self.config)
        free = ("products", "preflight", "json", "search", "bundle")
        open_folder(out, self, mutable=[*resume_mutable("vae", "denoiser"), *free])
        frames = self.frames(out)
        networks = Networks.random(configs.get(self.config), seed=0)
        networks.vae = self._autoencoder(frames, out)
        latents = {split: self._encode(split, frames[split], out) for split in frames}
        joined = {"train": _joined(latents, out / "latents" / "joined"), "test": latents["test"]}
        if self.bundle is not None:
            from egosim_jax.train.bundle import write_bundle

            write_bundle(
                self.bundle,
                self.stages()["denoiser"],
                latents=joined,
                weights=self.weights or out / "weights",
                dtype=self.weights_dtype,
            )
            print(self.bundle)
            return ExitCode.DONE
        trained = train(
            *self.stages()["denoiser"],
            data=joined["train"],
            validation=joined["test"],
            out=out / "denoiser",
            weights=self.weights,
            samples=Samples(
                model=self.trained_model(), latents=joined["test"], vae=out / "weights"
            ),
            run_folder=out,
        )
        networks.dit, networks.text, networks.image = trained.dit, trained.text, trained.image
        networks.save(out / "weights", dtype=self.weights_dtype)
        print(out / "weights")
        return ExitCode.DONE

    def _for_bundle(self, bundle: Path) -> FromScratch:
        """Return this recipe with the defaults of a bundle. Raises `InputError` if that exists."""
        from egosim_jax.train.bundle import check_new

        check_new(bundle)
        return replace(
            self,
            out=self.out or bundle.with_name(f"{bundle.name}_data"),
            weights=self.weights or configs.shipped_weights(self.config),
        )

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
        # The written weights encode, in a run that was interrupted and in one that was not.
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
            run_folder=out,
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
            # To validate: a clip's first window and, if the clip is longer, its last.
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


def _joined(latents: Mapping[str, Path], out: Path) -> Path:
    """Return the folder of the latents to train on, into which those of several are moved."""
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
    """CSV or JSONL in EgoSim's columns; if no clip has the split test, every eighth is held out."""
    clips: int = 0
    """Synthetic clips to make instead, of the tabletop world; every fourth is for testing."""
    clip_frames: int = 61
    """Frames of every clip, from which windows are cut."""

    def train(self) -> int:
        """Train on the clips. Raises `InputError` if there are none."""
        if not self.clips:
            self.require(*(("metadata",) if self.bundle else ("out", "metadata")))
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

        spec = replace(configs.get(self.config).video, frames=self.clip_frames)
        made = (to_triplet(next(make_sequence(seed, spec=spec))) for seed in range(self.clips))
        splits = ({"split": "test" if n % 4 == 3 else "train"} for n in range(self.clips))
        clips = (replace(clip, extra=extra) for clip, extra in zip(made, splits, strict=True))
        write_clips(folder, clips, fps=spec.fps)

    def _pack(self, metadata: Path, split: Literal["train", "test"], out: Path) -> Path:
        from egosim_jax.data.manifest import MANIFEST
        from egosim_jax.data.metadata import read_metadata
        from egosim_jax.data.pack import pack

        frames = out / "frames" / split
        if not (frames / MANIFEST).exists():
            items = of_split(read_metadata(metadata), split)
            model = configs.get(self.config)
            progress = pack(
                items,
                out=frames,
                spec=replace(model.video, frames=self.clip_frames),
                grid=model.grid,
                provenance={"metadata": str(metadata)},
            )
            for problem in track(progress, f"packing {split}", total=len(items)):
                if problem:
                    print(f"skipped: {problem}", file=sys.stderr)
                stop_if_preempted(out)
        return frames


def of_split(items: Sequence[ClipFiles], split: Literal["train", "test"]) -> list[ClipFiles]:
    """Return the clips to train on, or those to validate on.

    If all are to be trained on, by their column `split` or without it, every eighth clip is held
    out, or else the last. Raises `InputError` for a single clip and for other splits.
    """
    from egosim_jax.data.metadata import select

    if {item.extra.get("split", "train") for item in items} != {"train"}:
        return select(items, where=f"split={split}")
    if len(items) < 2:
        raise InputError(
            "The metadata has one clip: another one is needed to validate on. Cut the video into "
            "shorter clips, or add one. (--metadata)"
        )
    count = len(items)
    held_out = range(HELD_OUT - 1, count, HELD_OUT) or range(count - 1, count)
    if split == "test":
        print(f"no clip has the split test: {len(held_out)} of {count} are held out")
    return [item for n, item in enumerate(items) if (n in held_out) == (split == "test")]


@dataclass(frozen=True, kw_only=True)
class FromTabletop(FromScratch):
    """Train a small model from scratch on scenes of the tabletop world, a quarter with a robot."""

    help_groups: ClassVar[HelpGroups] = {
        "data": (
            "first_scene", "held_out", "black_cloths", "attempts", "rollouts", "rollout_clips",
            "twins",
        ),
        **FromScratch.help_groups,
    }  # fmt: skip
    scenes: int = 1000
    """Scenes to train on, two clips of each."""
    first_scene: int = FIRST_TRAINED
    """Seed of the first of these scenes; other scenes train given weights further."""
    held_out: int = 48
    """Scenes to validate on, one clip of each."""
    black_cloths: int = 0
    """Maximum number of black cloths on a table, which in a prior look like unobserved places."""
    attempts: float = 0.0
    """Share of the scenes in which a policy may fail and the head turns, not a script."""
    rollouts: int = 0
    """Further scenes to train on, with states of the given weights' own rollouts."""
    rollout_clips: int = 4
    """Clips of each of these scenes."""
    twins: bool = False
    """Static twins and hands as meshes, as DWM is conditioned on, of human hands alone."""

    def __post_init__(self) -> None:
        """Raise `InputError` for scenes that are held out, and for rollouts that cannot be made.

        Those need a model that makes them, and have no static twins.
        """
        if self.first_scene < FIRST_TRAINED:
            raise InputError(
                f"Scenes of seeds below {FIRST_TRAINED} are held out: --first-scene must be at "
                f"least {FIRST_TRAINED}, not {self.first_scene}."
            )
        if self.twins and self.rollouts:
            raise InputError(
                f"{self.rollouts} scenes of rollouts cannot have static twins, which show each "
                "clip's own first frame: omit one of them. (--rollouts, --twins)"
            )
        if self.rollouts < 0 or (self.rollouts and self.weights is None):
            raise InputError(
                f"{self.rollouts} scenes of rollouts cannot be made: there must be at least 0, and "
                "weights of the model whose rollouts they are. (--rollouts, --weights)"
            )

    def frames(self, out: Path) -> Mapping[str, Path]:
        """Make the clips of all splits."""
        first, last = self.first_scene, self.first_scene + self.scenes
        frames = {
            "train": self._make("train", range(first, last), 2, out),
            "test": self._make("test", range(self.held_out), 1, out),
        }
        if self.rollouts:
            seeds = range(last, last + self.rollouts)
            frames["rollouts"] = self._make("rollouts", seeds, self.rollout_clips, out)
        return frames

    def _make(self, split: str, seeds: range, clips: int, out: Path) -> Path:
        from egosim_jax.train.rollout_states import OwnRollouts
        from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards, true_states

        model = configs.get(self.config)
        plan = DatasetConfig(
            seeds=tuple(seeds),
            clips=clips,
            spec=model.video,
            kind="human" if self.twins else "mixed",
            black_cloths=self.black_cloths,
            attempts=self.attempts if split == "train" else 0.0,
            prior="static" if self.twins else "state",
            hands="mesh" if self.twins else "skeleton",
        )
        frames = out / "frames" / split
        workers, states = os.cpu_count() or 1, true_states
        if split == "rollouts" and self.weights is not None:
            # A generator takes all cores by itself.
            workers, states = 1, OwnRollouts.of(self.config, self.weights)
        scenes = make_shards(plan, out=frames, workers=workers, grid=model.grid, states=states)
        for _ in track(scenes, f"making {split}", total=len(seeds)):
            stop_if_preempted(out)
        return frames
