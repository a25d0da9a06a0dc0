"""Clips, latents and trainings of `egosim experiment dwm`; existing ones are loaded.

    clips -> autoencoder -> latents -> base models -> DWM and its ablations

The inpainting base learns from clips with hidden pixels: all after the first frame, or a box. The
image-to-video base sees the first frame, then black.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import jax.numpy as jnp
import numpy as np
from flax import nnx

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.convert.widen import Widening
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.mixing import write_mixture
from egosim_jax.data.pack import clip_metadata
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.experiments.config import DWM, Hyperparameters
from egosim_jax.experiments.dwm_variants import (
    BASES,
    MIXED,
    VARIANTS,
    Base,
    Camera,
    Cameras,
    Hands,
    Variant,
    poses_of,
    with_layout,
)
from egosim_jax.experiments.training import make_frames, train_config, train_denoiser
from egosim_jax.generation.encoding import batches
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.rendering.mesh import hand_mask
from egosim_jax.runtime.progress import track
from egosim_jax.train import loop
from egosim_jax.train.encode import Encoding
from egosim_jax.train.tasks.autoencoding import Autoencoding, latent_statistics
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import Triplet
from egosim_jax.worlds.tabletop import TabletopClip, make_sequence
from egosim_jax.worlds.tabletop.dataset import DatasetConfig

Split = Camera | Literal["held_out"]
CROP = (64, 80)
"""Maximum height and width of the training crops of the autoencoder."""
SPLITS = 10_000
"""Distance between the first seeds of two splits."""
FIRST_FRAME_SHARE = 0.6
"""Fraction of the inpainting base's clips that show only the first frame."""
NO_PRIOR = 0.2
"""Fraction of its samples without a prior, to learn generation from text alone."""


class Training:
    """Trainings of the experiment and their data."""

    def __init__(self, settings: DWM):
        self.settings, self.out = settings, settings.out
        model = configs.get(settings.config)
        dit = replace(model.dit, products=settings.products)
        self.config = replace(model, steps=settings.steps, dit=dit)
        counts: dict[Split, int] = {
            "held_out": settings.held_out,
            "moving": settings.moving_scenes,
            "fixed": settings.fixed_scenes,
        }
        self.seeds: dict[Split, range] = {
            split: range(start := settings.first_scene + number * SPLITS, start + count)
            for number, (split, count) in enumerate(counts.items())
        }

    def base_model(self, base: Base) -> ModelConfig:
        """Return the config of a base model."""
        return with_layout(self.config, BASES[base], base)

    def frames(self, split: Split) -> Path:
        """Make the clips of a split, with static versions and hand meshes."""
        config = DatasetConfig(
            seeds=tuple(self.seeds[split]),
            clips=1,
            spec=self.config.video,
            kind="human",
            prior="static",
            hands="mesh",
            fixed_camera=split == "fixed",
        )
        return make_frames(config, self.out / "frames" / split, grid=self.config.grid)

    def autoencoder(self) -> Path:
        """Train the autoencoder; return the folder of its weights."""
        out, path = self.out / "autoencoder", self.out / "autoencoder/weights/vae.safetensors"
        if not path.exists():
            frames = self.frames("moving")
            video = self.config.video
            crop = min(CROP[0], video.height), min(CROP[1], video.width)
            task = Autoencoding(vae=self.config.vae, video=video, crop=crop)
            vae = loop.train(
                task,
                train_config(self.settings.autoencoder),
                data=frames,
                validation=self.frames("held_out"),
                out=out,
            )
            videos = (record.arrays["target"] for record in ShardReader(frames))
            vae.standardize(*latent_statistics(vae, videos))
            weights.save(path, vae)
        return path.parent

    def latents(self, kind: Base | Hands, split: Split) -> Path:
        """Encode the clips of a split for a kind of training; return the shards."""
        out = self.out / "latents" / f"{kind}_{split}"
        if (out / MANIFEST).exists():
            return out
        model = self._encoded_as(kind)
        source = ShardReader(self.frames(split))
        folder = self.autoencoder()
        encode = Encoding(model, Networks.load(model, folder, only=model.cached_networks))
        provenance = {
            "kind": kind,
            "sources": [source.manifest.fingerprint],
            "encoders": weights.hashes(folder, only=model.cached_networks),
        }
        clips = [
            changed(clip, kind, self.clip(split, seed) if kind == "poses" else None)
            for seed, clip in zip(self.seeds[split], _clips(source), strict=True)
        ]
        size = self.settings.batch_size
        parts = track(
            list(batches(clips, size)), f"encoding {out.name}", total=-(-len(clips) // size)
        )
        with ShardWriter(
            out, kind="latents", spec=model.video, grid=model.grid, provenance=provenance
        ) as writer:
            for batch in parts:
                filled = [*batch, *[batch[-1]] * (size - len(batch))]
                for clip, arrays in zip(batch, encode(filled), strict=False):
                    writer.add(arrays, clip_metadata(clip))
        return out

    def mixture(self, kind: Base | Hands, cameras: Cameras) -> Path:
        """Return latents shards of clips with these cameras, mixed by weight."""
        parts = {self.latents(kind, camera): weight for camera, weight in cameras}
        if len(parts) == 1:
            return next(iter(parts))
        out = self.out / "latents" / "_".join((kind, *dict(cameras)))
        write_mixture(out, parts)
        return out

    def clip(self, split: Split, seed: int) -> TabletopClip:
        """Return a clip of the world with the same events in tiny frames."""
        spec = replace(self.config.video, height=16, width=16)
        return next(make_sequence(seed, spec=spec, fixed_camera=split == "fixed"))

    def _encoded_as(self, kind: Base | Hands) -> ModelConfig:
        """Return a model that reads latents of this kind."""
        if kind == "inpaint" or kind == "image":
            return self.base_model(kind)
        return VARIANTS["adaln_frame"].model(self.config, kind) if kind == "poses" else self.config

    def base(self, base: Base) -> Path:
        """Train a base model from random weights; return the folder of its weights."""
        nothing = NO_PRIOR if base == "inpaint" else 0.0
        return self.train(
            f"base_{base}",
            Denoising(
                model=self.base_model(base),
                dropout=ConditionDropout(prior=nothing, text=self.settings.text_dropout),
            ),
            self.settings.base,
            data=self.mixture(base, MIXED),
            validation=self.latents(base, "held_out"),
        )

    def start(self, name: str, variant: Variant) -> Path:
        """Write a base with a variant's input channels; return the folder of its weights."""
        folder, base = self.out / name / "start", self.base(variant.base)
        if not (folder / "vae.safetensors").exists():
            model = variant.model(self.config, name)
            networks = Networks.random(model, seed=0)
            widen(
                networks,
                base,
                Widening(base=BASES[variant.base], layout=variant.layout, input_layer="patch"),
            )
            weights.save(folder / "dit.safetensors", cast(nnx.Module, networks.dit))
            weights.link_others(folder, base)
        return folder

    def variant(self, name: str, variant: Variant) -> tuple[Path, Path | None]:
        """Train a model of the comparison; return its weights folder and its LoRA, if any."""
        start, rank = self.start(name, variant), self.settings.rank
        if not variant.trained:
            return start, None
        rank = rank if variant.adapter else None
        done = self.train(
            name,
            Denoising(
                model=variant.model(self.config, name),
                dropout=ConditionDropout(text=self.settings.text_dropout),
                rank=rank,
            ),
            self.settings.adaptation,
            data=self.mixture(variant.hands, variant.data),
            validation=self.latents(variant.hands, "held_out"),
            start=start,
        )
        return (done, None) if rank is None else (start, done)

    def train(
        self,
        name: str,
        task: Denoising,
        stage: Hyperparameters,
        *,
        data: Path,
        validation: Path,
        start: Path | None = None,
    ) -> Path:
        """Train a denoiser; return its weights folder, or the file of its LoRA."""
        return train_denoiser(
            task,
            stage,
            data=data,
            validation=validation,
            out=self.out / name,
            start=start,
            others=self.autoencoder,
        )


def widen(networks: Networks, base: Path, widening: Widening) -> None:
    """Fill a denoiser with the weights of a base that has fewer input channels.

    New channels have zero weights; layers that the base lacks stay random.
    """
    known = read_safetensors(base / "dit.safetensors")
    state = nnx.state(networks.dit, nnx.Param)
    for path, leaf in nnx.to_flat_state(state):
        name = ".".join(map(str, path))
        if name == f"{widening.input_layer}.kernel":
            kernel = np.zeros(leaf.shape, np.float32)
            kernel[widening.rows] = known[name].array()
            leaf.set_value(jnp.asarray(kernel))
        elif name in known:
            leaf.set_value(jnp.asarray(known[name].array()))
    nnx.update(networks.dit, state)


def _clips(source: ShardReader) -> Iterator[Triplet]:
    for record in source:
        named: dict[str, Any] = {n: str(record.metadata[n]) for n in ("video_id", "prompt")}
        yield Triplet(**{**named, **record.arrays})


def changed(clip: Triplet, kind: Base | Hands, events: TabletopClip | None = None) -> Triplet:
    """Return a clip with the prior, mask and hands for a kind of training.

    `events` is the clip in the world, from which hand poses are taken.
    """
    target = clip.target
    if events is not None:
        return replace(clip, tokens=poses_of(events))
    if kind == "mask":
        return replace(clip, hands=hand_mask(clip.hands))
    if kind == "mesh" or target is None:
        return clip
    # Seeded by the clip's id: a clip has the same mask in every run.
    rng = np.random.default_rng(list(clip.video_id.encode()))
    hidden = np.zeros(target.shape[:3], bool)
    if kind == "image" or rng.random() < FIRST_FRAME_SHARE:
        hidden[1:] = True
    else:
        size = (rng.uniform(0.25, 0.75, 2) * target.shape[1:3]).astype(int)
        top, left = (rng.integers(0, np.array(target.shape[1:3]) - size + 1)).tolist()
        hidden[1:, top : top + size[0], left : left + size[1]] = True
    prior = np.where(hidden[..., None], np.uint8(0), target)
    return replace(clip, prior=prior, mask=np.where(hidden, np.uint8(255), np.uint8(0)))
