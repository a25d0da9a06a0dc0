"""Clips, shards and videos have the frames that were written."""

import csv
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from egosim_jax.annotate.frames import Sampling, plan, read_frames
from egosim_jax.annotate.sources import find_sources, open_source
from egosim_jax.cli.data import Pack
from egosim_jax.data.clips import load_triplet
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.pack import read_triplets
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.video import probe_video, read_video
from egosim_jax.io.writing import write_video
from egosim_jax.types import VideoSpec
from tests.captures import coded, encode, shown

VIDEOS = {
    "video": "videos/0.mp4",
    "ego_prior_video": "videos_static/0.mp4",
    "hand_keypoint_video": "videos_hands/0.mp4",
}


@pytest.fixture
def write_table(tmp_path):
    """Return a function that writes a clip: left its frame's number, right its video's level."""

    def write(fps=24):
        row = {"prompt": "Hände", "video_id": "a", "first_frame": "image.png", **VIDEOS}
        for number, name in enumerate(VIDEOS.values()):
            frames = coded(25)
            frames[:, :, 24:] = 60 + 60 * number
            write_video(tmp_path / name, frames, fps)
        odd = np.zeros_like(frames)
        odd[1::2] = 255
        write_video(tmp_path / "videos_static/pc_mask_video.mp4", odd, fps)
        Image.fromarray(coded(25)[3]).save(tmp_path / "image.png")
        with (tmp_path / "metadata.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(row))
            writer.writeheader()
            writer.writerow(row)
        return tmp_path / "metadata.csv"

    return write


def assert_taken(triplet, frames):
    """Each video of a clip has these frames, and is the one that it should be."""
    for number, video in enumerate((triplet.target, triplet.prior, triplet.hands)):
        assert shown(video, 25) == frames
        np.testing.assert_allclose(video[0, :, -4:], 60 + 60 * number, atol=3)
    odd = triplet.mask.mean(axis=tuple(range(1, triplet.mask.ndim))) > 127
    assert odd.tolist() == [frame % 2 == 1 for frame in frames]
    np.testing.assert_allclose(triplet.first_frame, coded(25)[3, 0, 0, 0], atol=1)


def test_a_row_of_a_table_has_the_frames_of_its_videos(write_table):
    (files,) = read_metadata(write_table())
    spec = VideoSpec(frames=9, height=64, width=96, fps=24)
    triplet = load_triplet(files, spec, start=8)
    assert (triplet.video_id, triplet.prompt) == ("a", "Hände")
    assert triplet.target.shape == (9, 64, 96, 3)
    assert_taken(triplet, list(range(8, 17)))


@pytest.mark.parametrize(
    ("rule", "fps", "frames"),
    [
        ("first", 24, list(range(9))),
        ("stride", 24, list(range(0, 18, 2))),
        ("linspace", 24, list(range(0, 25, 3))),
        ("rate", 24, list(range(0, 25, 3))),
        ("rate", 16, list(range(0, 18, 2))),
        ("step", 30, list(range(0, 25, 3))),
    ],
)
def test_packed_clips_have_the_frames_of_their_rule(rule, fps, frames, write_table, tmp_path):
    options = {"size": (32, 48), "num_frames": 9, "resampling": rule}
    assert Pack(metadata=write_table(fps), out=tmp_path / "shards", **options).run() == 0
    (triplet,) = read_triplets(ShardReader(tmp_path / "shards"))
    assert_taken(triplet, frames)


@pytest.mark.parametrize("count", [40, 41])
@pytest.mark.parametrize(
    ("fps", "asked", "taken"),
    [(30, None, 30), (60, 16.0, 16), (120, None, 60), (Fraction(30000, 1001), 10.0, 10)],
)
def test_annotation_takes_the_frames_nearest_in_time(fps, asked, taken, count, tmp_path):
    write_video(tmp_path / "kitchen/take 1.mp4", coded(count, 48, 80), fps)
    (source,) = find_sources([tmp_path / "kitchen"])
    video = open_source(source)
    fitted = plan(video, Sampling(fps=asked), cut=True)
    frames = shown(read_frames(video, fitted, 0, fitted.count), count)
    assert (fitted.fps, frames[0], len(frames)) == (taken, 0, fitted.count)
    assert frames[-1] + fps / taken >= count - 0.5
    times_s = np.arange(fitted.count) / float(fitted.fps)
    assert np.abs(np.array(frames) / float(fps) - times_s).max() <= 0.5 / float(fps) + 1e-6


@pytest.mark.parametrize(
    ("suffix", "codec", "options", "fps"),
    [
        ("mp4", "libx264", {"g": "12", "bf": "3"}, Fraction(24000, 1001)),
        ("mkv", "libx264", {"g": "12", "bf": "3"}, Fraction(30)),
        ("mp4", "libsvtav1", {"preset": "12", "g": "8"}, Fraction(25)),
    ],
)
def test_every_way_to_read_a_video_gives_the_frames_asked_for(
    suffix, codec, options, fps, tmp_path
):
    frames, path = coded(30, 64, 96), tmp_path / f"video.{suffix}"
    encode(path, frames, rate=fps, codec=codec, options=options)
    info = probe_video(path)
    assert (info.frames, info.width, info.height, info.fps) == (30, 96, 64, fps)
    np.testing.assert_allclose(info.timeline.times_s, np.arange(30) / float(fps), atol=2e-3)
    readings = {
        range(30): read_video(path),
        range(11, 17): read_video(path, start=11, stop=17),
        range(9): read_video(path, stop=9, decoding="official"),
        range(13, 22): read_video(path, start=13, stop=22, whole=True),
        range(29, 30): read_video(path, start=29, stop=30, whole=True),
    }
    for frames, reading in readings.items():
        assert reading.fps == fps
        assert shown(reading.frames, 30) == list(frames)
