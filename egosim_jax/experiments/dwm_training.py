"""Models, clips, latents and trainings of `egosim experiment dwm`; existing ones are loaded.

    clips -> autoencoder -> latents -> base models -> DWM and its ablations

A model is described by its base, input channels, rendering of the hands and training clips.

The inpainting base learns from clips with hidden pixels: all after the first frame, or a box. The
image-to-video base sees the first frame, then black.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float32

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.conditioning.layout import COGVIDEOX_INPAINT, ChannelLayout
from egosim_jax.conditioning.layout import DWM as DWM_LAYOUT
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.convert.widen import Widening
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.mixing import write_mixture
from egosim_jax.data.pack import clip_metadata
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.experiments.config import DWM
from egosim_jax.experiments.training import make_frames, train_config, train_denoiser
from egosim_jax.generation.encoding import batches
from egosim_jax.geometry import invert, transform
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.cogvideox.motion import MotionDiTConfig
from egosim_jax.rendering.mesh import hand_mask
from egosim_jax.runtime.progress import track
from egosim_jax.train import loop
from egosim_jax.train.encode import Encoding
from egosim_jax.train.tasks.autoencoding import Autoencoding, latent_statistics
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import Triplet
from egosim_jax.worlds.tabletop import TabletopClip, make_sequence
from egosim_jax.worlds.tabletop.dataset import DatasetConfig

Base = Literal["inpaint", "image"]
"""Base model: CogVideoX-Fun's inpainting, or CogVideoX's image-to-video."""
Hands = Literal["mesh", "mask", "poses"]
"""Hands as shaded meshes, as their binary mask, or as joints that modulate the blocks."""
Camera = Literal["moving", "fixed"]
"""Camera of the clips: moving, as in DWM's synthetic clips, or fixed, as in its recordings."""

Cameras = tuple[tuple[Camera, float], ...]
"""Cameras of the training clips, each with its weight in the mixture."""
MOVING: Cameras = (("moving", 1.0),)
MIXED: Cameras = (("moving", 5.0), ("fixed", 2.0))
"""Mixture of moving and fixed cameras."""

SIDES, JOINTS = ("left", "right"), 21
POSE_DIM = len(SIDES) * (1 + 3 * JOINTS)
"""Number of values for the poses of both hands in a frame."""
STATIC = replace(COGVIDEOX_INPAINT, mask_packing="observed")
"""DWM without hands: 33 channels; the static scene is observed everywhere."""
IMAGE = ChannelLayout(parts=(("noisy", 16), ("prior", 16)), mask_prior=False)
"""CogVideoX's image-to-video model: 32 channels; the prior is the first frame, then black."""
IMAGE_HANDS = ChannelLayout(parts=(("noisy", 16), ("prior", 16), ("hands", 16)), mask_prior=False)
"""DWM on CogVideoX's image-to-video model: 48 channels, without a mask."""
BASES: Mapping[Base, ChannelLayout] = {"inpaint": COGVIDEOX_INPAINT, "image": IMAGE}
"""Input channels of the base models."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A model of the comparison; the default is DWM."""

    title: str
    """Name in the tables."""
    base: Base = "inpaint"
    """Base model with the initial weights."""
    layout: ChannelLayout = DWM_LAYOUT
    """Input channels of the denoiser."""
    hands: Hands = "mesh"
    """Rendering of the hands."""
    data: Cameras = MIXED
    """Training clips."""
    poses: Literal["frame", "global"] | None = None
    """Joints that modulate a token: from its latent frame, or from all frames."""
    adapter: bool = True
    """Train a LoRA and the patch projection, not all weights."""
    trained: bool = True
    """Train the model; otherwise it is its base."""

    def model(self, config: ModelConfig, name: str) -> ModelConfig:
        """Return the model with the sizes of a config."""
        model = with_layout(config, self.layout, name)
        if self.poses is None:
            return model
        sizes = {f.name: getattr(model.dit, f.name) for f in fields(model.dit)}
        dit = MotionDiTConfig(**sizes, frames=self.poses, pose_dim=POSE_DIM)
        return replace(model, dit=dit, zero_image_tokens=model.video.frames)


def with_layout(config: ModelConfig, layout: ChannelLayout, name: str) -> ModelConfig:
    """Return a model with other input channels and another name."""
    dit = replace(cast(CogVideoXDiTConfig, config.dit), in_channels=layout.channels)
    return replace(config, name=f"{config.name}_{name}", dit=dit, layout=layout)


def poses_of(clip: TabletopClip) -> Float32[np.ndarray, "f p"]:
    """Return the joints of left and right hand in each frame's camera, in decimeters.

    Each hand has a 1 and 21 joints, or zeros if it is absent.
    """
    poses = np.zeros((len(clip.joints_m), len(SIDES), 1 + 3 * JOINTS), np.float32)
    for index, side in enumerate(clip.sides):
        place = SIDES.index(side)
        poses[:, place, 0] = 1
        for frame, world_from_camera in enumerate(clip.cameras.world_from_camera):
            local = transform(invert(world_from_camera), clip.joints_m[frame, index])
            poses[frame, place, 1:] = 10 * local.reshape(-1)
    return poses.reshape(len(poses), -1)


VARIANTS: Mapping[str, Variant] = {
    "full": Variant(title="DWM"),
    "no_hands": Variant(title="fine-tuned without hands", layout=STATIC),
    "moving_only": Variant(title="moving cameras alone", data=MOVING),
    "adaln_global": Variant(
        title="joints, all frames alike, moving alone",
        layout=STATIC,
        hands="poses",
        poses="global",
        data=MOVING,
    ),
    "adaln_frame": Variant(
        title="joints by frame, moving alone",
        layout=STATIC,
        hands="poses",
        poses="frame",
        data=MOVING,
    ),
    "hand_mask": Variant(title="hands as masks, moving alone", hands="mask", data=MOVING),
    "untrained": Variant(title="DWM, 0 updates", trained=False),
    "image_base": Variant(
        title="from the image model", base="image", layout=IMAGE_HANDS, adapter=False
    ),
    "image_untrained": Variant(
        title="from the image model, 0 updates", base="image", layout=IMAGE_HANDS, trained=False
    ),
}
"""Models by name, in order of training and display."""

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
            frames, video = self.frames("moving"), self.config.video
            crop = min(CROP[0], video.height), min(CROP[1], video.width)
            vae = loop.train(
                Autoencoding(vae=self.config.vae, video=video, crop=crop),
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
        source, folder = ShardReader(self.frames(split)), self.autoencoder()
        model, size = self.config, self.settings.batch_size
        if kind == "poses":
            model = VARIANTS["adaln_frame"].model(model, kind)
        elif kind == "inpaint" or kind == "image":
            model = self.base_model(kind)
        encode = Encoding(model, Networks.load(model, folder, only=model.cached_networks))
        provenance = {
            "kind": kind,
            "sources": [source.manifest.fingerprint],
            "encoders": weights.hashes(folder, only=model.cached_networks),
        }
        clips = []
        for seed, record in zip(self.seeds[split], source, strict=True):
            named: dict[str, Any] = {n: str(record.metadata[n]) for n in ("video_id", "prompt")}
            events = self.events(split, seed) if kind == "poses" else None
            clips.append(changed(Triplet(**{**named, **record.arrays}), kind, events))
        parts = list(batches(clips, size))
        with ShardWriter(
            out, kind="latents", spec=model.video, grid=model.grid, provenance=provenance
        ) as writer:
            for batch in track(parts, f"encoding {out.name}", total=len(parts)):
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

    def events(self, split: Split, seed: int) -> TabletopClip:
        """Return a clip of the world with the same events in tiny frames."""
        spec = replace(self.config.video, height=16, width=16)
        return next(make_sequence(seed, spec=spec, fixed_camera=split == "fixed"))

    def base(self, base: Base) -> Path:
        """Train a base model from random weights; return the folder of its weights."""
        dropout = ConditionDropout(
            prior=NO_PRIOR if base == "inpaint" else 0.0, text=self.settings.text_dropout
        )
        return train_denoiser(
            Denoising(model=self.base_model(base), dropout=dropout),
            self.settings.base,
            data=self.mixture(base, MIXED),
            validation=self.latents(base, "held_out"),
            out=self.out / f"base_{base}",
            start=None,
            others=self.autoencoder,
        )

    def start(self, name: str, variant: Variant) -> Path:
        """Write a base with a variant's input channels; return the folder of its weights."""
        folder, base = self.out / name / "start", self.base(variant.base)
        if not (folder / "vae.safetensors").exists():
            networks = Networks.random(variant.model(self.config, name), seed=0)
            layouts = {"base": BASES[variant.base], "layout": variant.layout}
            widen(networks, base, Widening(**layouts, input_layer="patch"))
            weights.save(folder / "dit.safetensors", cast(nnx.Module, networks.dit))
            weights.add_others(folder, base)
        return folder

    def variant(self, name: str, variant: Variant) -> tuple[Path, Path | None]:
        """Train a model of the comparison; return its weights folder and its LoRA, if any."""
        start = self.start(name, variant)
        if not variant.trained:
            return start, None
        rank = self.settings.rank if variant.adapter else None
        dropout = ConditionDropout(text=self.settings.text_dropout)
        trained = train_denoiser(
            Denoising(model=variant.model(self.config, name), dropout=dropout, rank=rank),
            self.settings.adaptation,
            data=self.mixture(variant.hands, variant.data),
            validation=self.latents(variant.hands, "held_out"),
            out=self.out / name,
            start=start,
            others=self.autoencoder,
        )
        return (trained, None) if rank is None else (start, trained)


def widen(networks: Networks, base: Path, widening: Widening) -> None:
    """Fill a denoiser with the weights of a base that has fewer input channels.

    New channels have zero weights; layers that the base lacks stay random.
    """
    weights_of_base = read_safetensors(base / "dit.safetensors")
    state = nnx.state(networks.dit, nnx.Param)
    for path, leaf in nnx.to_flat_state(state):
        name = ".".join(map(str, path))
        if name == f"{widening.input_layer}.kernel":
            kernel = np.zeros(leaf.shape, np.float32)
            kernel[widening.rows] = weights_of_base[name].array()
            leaf.set_value(jnp.asarray(kernel))
        elif name in weights_of_base:
            leaf.set_value(jnp.asarray(weights_of_base[name].array()))
    nnx.update(networks.dit, state)


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
