"""Photos as users have them, in every command that opens an image: turned, of another shape."""

import json

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.data import Pack
from egosim_jax.cli.episode import MakeEpisode
from egosim_jax.data.clips import check_clip, load_triplet
from egosim_jax.data.crop import plan_crop
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.transforms import decode_record
from egosim_jax.geometry import invert, project, transform
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError, VideoSpec
from tests.unit.annotate.stubs import mean_hand

INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
TURNS = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: np.swapaxes(a, 0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(np.swapaxes(a, 0, 1), 2),
    8: lambda a: np.rot90(a),
}
FOCAL = 138.6
ACTION = {
    "world_from_camera": np.tile(np.eye(4), (17, 1, 1)),
    "intrinsics_px": np.array([[FOCAL, 0, 79.5], [0, FOCAL, 47.5], [0, 0, 1]]),
    "joints_m": np.full((17, 1, 21, 3), np.nan),
}


def store(path, image, turn):
    """Write an image whose stored pixels are turned, and whose tag turns them back."""
    exif = Image.Exif()
    exif[0x0112] = turn
    pixels = np.ascontiguousarray(TURNS[INVERSE[turn]](image))
    Image.fromarray(pixels).save(path, exif=exif)


def load(clips, spec):
    return load_triplet(read_metadata(clips)[0], spec).first_frame


def pack_files(clips, spec):
    Pack(metadata=clips, out=clips.parent / "packed").run()
    return decode_record(ShardReader(clips.parent / "packed")[0].arrays, spec)["first_frame"]


def pack_frames(clips, spec):
    Pack(metadata=clips, out=clips.parent / "packed", size=(32, 48), num_frames=9).run()
    return ShardReader(clips.parent / "packed")[0].arrays["first_frame"]


@pytest.mark.parametrize(("opener", "turn"), [(load, 2), (pack_files, 6), (pack_frames, 7)])
def test_the_image_of_a_clip_is_turned(clips, opener, turn):
    spec = VideoSpec(frames=9, height=32, width=48)
    expected = load(clips, spec)
    store(clips.parent / "clip0/first_frame.png", expected, turn)
    assert not check_clip(read_metadata(clips)[0], spec)
    np.testing.assert_array_equal(opener(clips, spec), expected)


def write_action(path, *, prompt=None):
    if path.suffix == ".npz":
        np.savez(path, **ACTION)
        return path
    lists = {name: array.tolist() for name, array in ACTION.items()} | {"joints_m": [[None]] * 17}
    path.write_text(json.dumps(lists | ({"prompt": prompt} if prompt else {})))
    return path


def make(folder, image, depth, *, turn=1, action="clip.json", **options):
    store(folder / "photo.png", image, turn)
    np.savez(folder / "depth.npz", depth_m=depth)
    path = write_action(folder / action)
    MakeEpisode(
        out=folder / "episode",
        actions=(path,),
        image=folder / "photo.png",
        depth=folder / "depth.npz",
        **options,
    ).run()
    return Episode.load(folder / "episode")


def disc(rows, columns, radius):
    y, x = np.mgrid[:rows, :columns]
    inside = np.hypot(y - (rows - 1) / 2, x - (columns - 1) / 2) < radius
    image = np.full((rows, columns, 3), 90, np.uint8)
    image[inside] = (220, 40, 40)
    return image


@pytest.mark.parametrize("turn", [1, 4, 5, 8])
def test_the_scene_of_a_photo_is_turned(tmp_path, turn):
    image = np.random.default_rng(0).integers(0, 256, (96, 160, 3)).astype(np.uint8)
    depth = np.linspace(0.4, 0.9, 96 * 160).reshape(96, 160)
    episode = make(tmp_path, image, depth, turn=turn)
    np.testing.assert_array_equal(episode.first_frame, image)
    np.testing.assert_array_equal(episode.state.colors, image.reshape(-1, 3))
    np.testing.assert_allclose(episode.state.points_m[:, 2], depth.ravel(), rtol=1e-6)


@pytest.mark.parametrize("unit_m", [1.0, 0.001, 10.0])
def test_depth_of_another_unit_than_the_hands_is_refused(tmp_path, monkeypatch, unit_m):
    hand = np.tile(mean_hand() / 2 + [0, 0, 0.5], (17, 1, 1, 1))
    monkeypatch.setitem(ACTION, "joints_m", hand)
    image, depth = np.zeros((96, 160, 3), np.uint8), np.full((96, 160), 0.6 / unit_m)
    if unit_m == 1:
        assert make(tmp_path, image, depth, action="clip.npz").state is not None
        return
    with pytest.raises(InputError, match=r"times their own distance.*\(--depth\)"):
        make(tmp_path, image, depth, action="clip.npz")


@pytest.mark.parametrize("size", [(480, 640), (300, 640), (96, 160)])
def test_photos_of_another_shape_are_cropped_with_their_scene(tmp_path, size):
    image = disc(*size, radius=min(size) / 4)
    episode = make(tmp_path, image, np.full(size, 0.6))
    red = episode.state.points_m[(episode.state.colors == (220, 40, 40)).all(axis=1)]
    across, down, _ = np.ptp(red, axis=0)
    assert across == pytest.approx(down, rel=0.02)
    cameras = episode.actions[0].cameras
    u, v = project(cameras.intrinsics_px, transform(invert(cameras.world_from_camera[0]), red))
    rows, columns = np.nonzero(episode.first_frame[..., 0] > 155)
    for found, drawn in ((u, columns), (v, rows)):
        assert found.min() == pytest.approx(drawn.min(), abs=0.8)
        assert found.max() == pytest.approx(drawn.max(), abs=0.8)


@pytest.mark.parametrize("source", [(480, 640), (1080, 1920), (97, 161)])
def test_intrinsics_of_the_image_and_of_the_crop_are_inverse(source):
    crop = plan_crop(source, (96, 160), name="photo", fix="")
    image_px = np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])
    fitted = crop.intrinsics(image_px)
    np.testing.assert_allclose(crop.source_intrinsics(fitted), image_px)
    center = [(source[1] - 1) / 2, (source[0] - 1) / 2, 1]
    image_px[:, 2] = center
    np.testing.assert_allclose(crop.intrinsics(image_px)[:2, 2], [79.5, 47.5])
