"""Small models and random data for tests, here and in projects that use the package.

Everything is made in seconds on a CPU, from a seed, in the formats of the real data:

    model = testing.tiny_model()
    weights = testing.write_weights(tmp_path / "weights", model)
    latents = testing.write_latents(tmp_path / "latents", model)
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.data.metadata import MASK_NAME
from egosim_jax.data.shards import ShardWriter
from egosim_jax.io.weights import hashes
from egosim_jax.io.writing import write_video
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.train.encode import example_shapes, mask_of
from egosim_jax.types import Triplet, VideoSpec


def tiny_model(**changes: Any) -> ModelConfig:
    """Return a model whose denoiser has 24 channels, for clips of 5 frames of 32x16 pixels.

    `changes` replace fields of the config.
    """
    fields: dict[str, Any] = {
        "video": VideoSpec(frames=5, height=16, width=32),
        "encoders": "frozen",
        "dit": WanDiTConfig(dim=24, ffn_dim=32, heads=2, layers=2, text_dim=64, image_dim=32),
    }
    return dataclasses.replace(configs.get("debug"), **{**fields, **changes})


def random_triplet(video: VideoSpec, seed: int = 0, *, observed: bool = False) -> Triplet:
    """Return a triplet of noise, without a target and without rendering.

    The mask is noise too, or everything is `observed`, as DWM's models need.
    """
    rng = np.random.default_rng(seed)
    frames = (video.frames, video.height, video.width)

    def draw(*shape: int) -> np.ndarray:
        return rng.integers(0, 256, shape).astype(np.uint8)

    return Triplet(
        video_id=f"clip_{seed}",
        prompt=f"take cup {seed}",
        prior=draw(*frames, 3),
        mask=(0 if observed else 255) * draw(*frames).astype(bool).astype(np.uint8),
        hands=draw(*frames, 3),
        first_frame=draw(*frames[1:], 3),
    )


def smooth_video(seed: int, frames: int, height: int, width: int) -> UInt8[np.ndarray, "f h w 3"]:
    """Return a smooth video, different for every seed and in every frame."""
    f, y, x = np.meshgrid(np.arange(frames), np.arange(height), np.arange(width), indexing="ij")
    phase = 2 * np.pi * np.stack([y / height, x / width, (x + y) / width], axis=-1)
    waves = np.sin(phase + 0.3 * f[..., None] + seed * np.array([1.0, 2.0, 3.0]))
    return (128 + 100 * waves).astype(np.uint8)


def write_dataset(
    folder: Path, clips: int = 2, *, frames: int = 9, height: int = 32, width: int = 48
) -> Path:
    """Write videos of clips and their metadata in EgoSim's layout; return the metadata's path.

    Every second clip is in the split `test`. The upper half of each mask is unobserved.
    """
    rows = []
    for index in range(clips):
        clip = folder / f"clip{index}"
        mask = np.zeros((frames, height, width, 3), np.uint8)
        mask[:, : height // 2] = 255
        names = ("video.mp4", "ego_prior_video.mp4", "hand_keypoint_video.mp4")
        videos = {
            name: smooth_video(10 * index + number, frames, height, width)
            for number, name in enumerate(names)
        }
        for name, pixels in {**videos, MASK_NAME: mask}.items():
            write_video(clip / name, pixels, 16)
        Image.fromarray(videos["video.mp4"][0]).save(clip / "first_frame.png")
        columns = ("video", "ego_prior_video", "hand_keypoint_video", "first_frame")
        paths = [f"{clip.name}/{name}" for name in (*names, "first_frame.png")]
        rows.append(
            {
                **dict(zip(columns, paths, strict=True)),
                "prompt": f"hands move, clip {index}",
                "video_id": clip.name,
                "split": "test" if index % 2 else "train",
            }
        )
    path = folder / "metadata.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_latents(
    folder: Path, model: ModelConfig, records: int = 7, *, weights: Path | None = None
) -> Path:
    """Write shards of random latents, as encoded clips for training a model; return the folder.

    With a folder of `weights` the shards have the hashes of its encoders, as fine-tuning requires.
    """
    rng = np.random.default_rng(0)

    def draw(name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        if name == "ids_mask":
            return np.ones(shape, dtype)
        if np.issubdtype(dtype, np.integer):
            return rng.integers(0, 2 if name == "mask" else 100, shape).astype(dtype)
        return rng.normal(size=shape).astype(dtype)

    encoders = {} if weights is None else hashes(weights, only=model.cached_networks)
    shards = ShardWriter(
        folder,
        kind="latents",
        spec=model.video,
        grid=model.grid,
        provenance={"config": model.name, "encoders": encoders, "mask": mask_of(model)},
    )
    shapes = example_shapes(model, 1)
    with shards as writer:
        for number in range(records):
            arrays = {name: draw(name, a.shape[1:], a.dtype) for name, a in shapes.items()}
            writer.add(arrays, {"video_id": f"clip_{number}", "prompt": ""})
    return folder


def write_weights(folder: Path, model: ModelConfig, *, seed: int = 0) -> Path:
    """Write random weights of all networks of a model; return the folder."""
    Networks.random(model, seed=seed).save(folder)
    return folder
