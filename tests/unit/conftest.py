"""Tiny clips on disk, in the layout of EgoSim's metadata."""

import csv

import numpy as np
import pytest
from PIL import Image

from egosim_jax.io.video import write_video

COLUMNS = ("video", "ego_prior_video", "hand_keypoint_video", "first_frame", "prompt", "video_id")
FRAMES, HEIGHT, WIDTH = 9, 32, 48


def moving_gradient(seed, frames=FRAMES, height=HEIGHT, width=WIDTH):
    """A smooth video, different for every seed and in every frame: `f h w 3`."""
    f, y, x = np.meshgrid(np.arange(frames), np.arange(height), np.arange(width), indexing="ij")
    phase = 2 * np.pi * (np.stack([y / height, x / width, (x + y) / width], axis=-1))
    waves = np.sin(phase + 0.3 * f[..., None] + seed * np.array([1.0, 2.0, 3.0]))
    return (128 + 100 * waves).astype(np.uint8)


def write_rows(path, rows):
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def make_clips(tmp_path):
    """Write `count` clips and their metadata.csv, half of them of split test; its path."""

    def make(count=2, frames=FRAMES, height=HEIGHT, width=WIDTH):
        rows = []
        for index in range(count):
            folder = tmp_path / f"clip{index}"
            mask = np.zeros((frames, height, width, 3), np.uint8)
            mask[:, : height // 2] = 255
            videos = {
                "video.mp4": moving_gradient(10 * index, frames, height, width),
                "ego_prior_video.mp4": moving_gradient(10 * index + 1, frames, height, width),
                "hand_keypoint_video.mp4": moving_gradient(10 * index + 2, frames, height, width),
                "pc_mask_video.mp4": mask,
            }
            for name, pixels in videos.items():
                write_video(folder / name, pixels, 16)
            Image.fromarray(videos["video.mp4"][0]).save(folder / "first_frame.png")
            rows.append(
                {
                    "video": f"clip{index}/video.mp4",
                    "ego_prior_video": f"clip{index}/ego_prior_video.mp4",
                    "hand_keypoint_video": f"clip{index}/hand_keypoint_video.mp4",
                    "first_frame": f"clip{index}/first_frame.png",
                    "prompt": f"hands move, clip {index}",
                    "video_id": f"clip{index}",
                    "split": "test" if index % 2 else "train",
                }
            )
        write_rows(tmp_path / "metadata.csv", rows)
        return tmp_path / "metadata.csv"

    return make


@pytest.fixture
def clips(make_clips):
    """Metadata of two clips of 9 frames, 48x32."""
    return make_clips()
