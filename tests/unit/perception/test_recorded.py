"""Reading of artifacts in the official layout."""

import zipfile
from pathlib import Path
from random import Random

import cv2
import numpy as np
import OpenEXR
import pytest

from egosim_jax.geometry import look_at, transform
from egosim_jax.io.digest import fingerprint
from egosim_jax.perception import recorded
from egosim_jax.perception.recorded import IDS_PER_STEP, RecordedConfig
from egosim_jax.types import Clip, InputError
from tests.fuzz.mutations import BYTES
from tests.scenes import pinhole, state_of, without_hands

FRAMES, HEIGHT, WIDTH = 5, 6, 8


def path():
    eyes = [np.array([0.1 * k, -0.4, 0.5 + 0.02 * k**2]) for k in range(FRAMES)]
    return np.stack([look_at(eye, np.zeros(3), up=np.array([0, 0, 1.0])) for eye in eyes])


CAMERAS = pinhole(path(), 9.0, HEIGHT, WIDTH)


def motion(scale=1.0):
    matrix = look_at(np.array([0.3, 0.2, 0.1]), np.ones(3), up=np.array([0, 1.0, 0]))
    matrix[:3, :3] *= scale
    return matrix


def asked(step=0):
    clip = Clip(frames=np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8), fps=8)
    return clip, without_hands(CAMERAS), state_of(np.zeros((1, 3)), step=step)


def write(folder: Path, *, scale=1.0, frames=FRAMES, depth=0.5):
    """Write a reconstruction's files in its own coordinates and unit."""
    for kind in ("pose", "intrinsics", "depth", "mask"):
        (folder / kind).mkdir(exist_ok=True)
    there = path()
    inverse = np.linalg.inv(motion(scale))
    there[:, :3, 3] = transform(inverse, there[:, :3, 3])
    there[:, :3, :3] = scale * inverse[:3, :3] @ there[:, :3, :3]
    numbers = np.arange(frames)
    np.savez(folder / "pose" / "clip.npz", data=there[:frames], inds=numbers)
    lenses = np.tile([9.0, 9, 3.5, 2.5], (frames, 1))
    np.savez(folder / "intrinsics" / "clip.npz", data=lenses, inds=numbers)
    pixels = np.full((HEIGHT, WIDTH), depth / scale, np.float16)
    pixels[0, 0], pixels[0, 1] = 0, np.nan
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": pixels}).write(str(folder / "one.exr"))
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[2], ids[3], ids[4] = 1, 2, 3
    cv2.imwrite(str(folder / "one.png"), ids)
    for kind, ending in (("depth", "exr"), ("mask", "png")):
        with zipfile.ZipFile(folder / kind / "clip.zip", "w") as archive:
            for number in range(frames):
                archive.write(folder / f"one.{ending}", f"{number:05d}.{ending}")
    (folder / "mask" / "clip.txt").write_text("1: red cup\n2: left hand\n3: sky\n")


@pytest.mark.parametrize(
    ("alignment", "scale"), [("orientations", 1.0), ("orientations and scale", 0.5)]
)
def test_cameras_and_depth_come_into_the_world(tmp_path, alignment, scale):
    write(tmp_path, scale=scale)
    found = RecordedConfig(folder=tmp_path, name="clip", alignment=alignment).build()(*asked())
    np.testing.assert_allclose(found.cameras.world_from_camera, path(), atol=1e-9)
    np.testing.assert_allclose(found.cameras.intrinsics_px, CAMERAS.intrinsics_px)
    assert np.isinf(found.depth_m[:, 0, :2]).all()
    np.testing.assert_allclose(found.depth_m[:, 1:], 0.5, rtol=1e-3)


def test_hands_are_negative_and_objects_have_ids_of_their_step(tmp_path):
    write(tmp_path)
    found = RecordedConfig(folder=tmp_path, name="clip").build()(*asked(step=2))
    assert (found.object_ids[:, 2] == 3 * IDS_PER_STEP + 1).all()
    assert (found.object_ids[:, 3] < 0).all()
    assert (found.object_ids[:, 4] == 0).all()
    assert found.names[3 * IDS_PER_STEP + 1] == "red cup"
    assert "left hand" not in found.names.values()
    assert found.step == 3


def test_each_file_is_read_once(tmp_path, monkeypatch):
    write(tmp_path)
    opened = []

    def counted(read):
        return lambda path, *args, **options: opened.append(path) or read(path, *args, **options)

    for name in ("read_arrays", "read_bytes", "open_regular"):
        monkeypatch.setattr(recorded, name, counted(getattr(recorded, name)))
    RecordedConfig(folder=tmp_path, name="clip").build()(*asked())
    assert len(opened) == len(set(opened)) == 5


def poses(**arrays):
    values = {"data": np.zeros((FRAMES, 4, 4)), "inds": np.arange(FRAMES), **arrays}
    return lambda folder: np.savez_compressed(folder / "pose" / "clip.npz", **values)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "depth" / "clip.zip").write_bytes(b"no zip"), r"clip\.zip is damaged"),
        (lambda f: (f / "pose" / "clip.npz").unlink(), r"pose/clip\.npz is missing"),
        (lambda f: (f / "mask" / "clip.txt").write_text("red cup\n"), "`id: phrase`"),
        (lambda f: write(f, frames=4), "is for 4 frames, the clip has 5"),
        (poses(data=np.zeros((3000, 3000))), "too large"),
        (poses(data=np.zeros((FRAMES, 3, 3))), "not finite numbers"),
    ],
)
def test_files_that_do_not_fit_a_clip_are_refused(tmp_path, damage, message):
    write(tmp_path)
    damage(tmp_path)
    with pytest.raises(InputError, match=message):
        RecordedConfig(folder=tmp_path, name="clip").build()(*asked())


@pytest.mark.parametrize("kind", ["depth", "mask"])
def test_every_damaged_archive_of_images_is_refused_in_one_line(tmp_path, kind):
    write(tmp_path)
    pipeline, random = RecordedConfig(folder=tmp_path, name="clip").build(), Random(0)
    field = "depth_m" if kind == "depth" else "object_ids"

    def read():
        return getattr(pipeline(*asked()), field)

    path = tmp_path / kind / "clip.zip"
    data = path.read_bytes()
    want = read()
    for _ in range(150):
        path.write_bytes(random.choice(BYTES)(data, random))
        messages = []
        try:
            np.testing.assert_array_equal(read(), want)
        except InputError as error:
            messages.append(str(error))
        assert not any("\n" in message for message in messages)


def test_each_step_reads_separate_files(tmp_path):
    for step, depth in ((1, 0.5), (2, 0.25)):
        write(tmp_path, depth=depth)
        for path in list(tmp_path.glob("*/clip.*")):
            path.rename(path.with_stem(f"clip_{step}"))
    read = RecordedConfig(folder=tmp_path, name="clip_{step}").build()
    for step, depth in enumerate((0.5, 0.25)):
        np.testing.assert_allclose(read(*asked(step)).depth_m[:, 1:], depth, rtol=1e-3)


def test_several_clips_are_not_read_from_the_same_files(tmp_path):
    config = RecordedConfig(folder=tmp_path, name="clip")
    config.check_clips(1)
    with pytest.raises(InputError, match=r"2 clips are simulated: the name must contain \{step\}"):
        config.check_clips(2)
    RecordedConfig(folder=tmp_path, name="clip_{step}").check_clips(2)


@pytest.mark.parametrize("name", ["clip", "cl{step}p"])
def test_changed_files_change_the_fingerprint(tmp_path, name):
    write(tmp_path)
    config = RecordedConfig(folder=tmp_path, name=name)
    before = fingerprint(config.build())
    assert fingerprint(config.build()) == before
    (tmp_path / "mask" / "clip.txt").write_text("1: blue cup\n")
    assert fingerprint(config.build()) != before
