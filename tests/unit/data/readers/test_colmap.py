"""COLMAP: both file formats give the scene's cameras and points; damaged models are refused."""

import json
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.readers.colmap import Colmap, make_lens
from egosim_jax.geometry import invert, project, transform
from egosim_jax.io.untrusted.colmap import read_model
from egosim_jax.types import InputError
from tests.captures import quaternions

POINTS = np.random.default_rng(3).uniform(-0.1, 0.1, (30, 3))
NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "FOV": 7}


def observe(world, coefficients):
    """Pixels of the points in every frame, in COLMAP's convention."""
    local = transform(invert(world.poses), np.broadcast_to(POINTS, (world.frames, *POINTS.shape)))
    k = np.array(coefficients or [0.0] * 4)
    zero = np.zeros(3)
    return [cv2.projectPoints(p, zero, zero, world.intrinsics, k)[0][:, 0] + 0.5 for p in local]


def write_model(
    root, world, *, binary, model="PINHOLE", distortion=(), skip=(), cameras=1, spread=0.0
):
    (fx, _, cx), (_, fy, cy), _ = world.intrinsics.tolist()
    focal = [fx] if model.startswith("SIMPLE") else [fx, fy]
    params = [*focal, cx + 0.5, cy + 0.5, *distortion]
    local = invert(world.poses)
    turn = quaternions(local[:, :3, :3])
    pixels = observe(world, [*distortion, 0, 0, 0, 0][:4] if distortion else None)
    frames = [n for n in range(world.frames) if n not in skip]
    folder = root / "sparse/0"
    folder.mkdir(parents=True)
    for frame in range(world.frames):
        path = root / f"images/frame_{frame}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(world.video[frame]).save(path)
    pose = {n: [turn[n, 3], *turn[n, :3], *local[n, :3, 3]] for n in frames}
    if binary:
        ids = range(1, cameras + 1)
        camera = b"".join(
            struct.pack(
                f"<iiQQ{len(params)}d",
                i,
                NUMBERS[model],
                world.width,
                world.height,
                *(value * (1 + spread * (i - 1)) for value in params),
            )
            for i in ids
        )
        (folder / "cameras.bin").write_bytes(struct.pack("<Q", cameras) + camera)
        images = struct.pack("<Q", len(frames))
        for n in frames:
            images += struct.pack("<I7dI", n + 1, *pose[n], 1 + n % cameras)
            images += f"frame_{n}.png".encode() + b"\0" + struct.pack("<Q", len(POINTS) + 1)
            for index, (x, y) in enumerate(pixels[n].tolist()):
                images += struct.pack("<ddq", x, y, 100 - index)
            images += struct.pack("<ddq", 1.0, 1.0, -1)
        (folder / "images.bin").write_bytes(images)
        points = struct.pack("<Q", len(POINTS))
        for index, point in enumerate(POINTS.tolist()):
            points += struct.pack("<Q3d3BdQ", 100 - index, *point, index, 2, 3, 0.25, 1)
            points += struct.pack("<II", 1, index)
        (folder / "points3D.bin").write_bytes(points)
        return folder
    words = " ".join(map(str, params))
    (folder / "cameras.txt").write_text(f"# list\n1 {model} {world.width} {world.height} {words}\n")
    lines = ["# images", "# POINTS2D[]"]
    for n in frames:
        lines.append(f"{n + 1} {' '.join(map(str, pose[n]))} 1 frame_{n}.png")
        seen = [f"{x} {y} {100 - i}" for i, (x, y) in enumerate(pixels[n].tolist())]
        lines.append(" ".join([*seen, "1.0 1.0 -1"]))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{100 - i} {' '.join(map(str, p))} {i} 2 3 0.25 1 {i}"
        for i, p in enumerate(POINTS.tolist())
    ]
    (folder / "points3D.txt").write_text("\n".join(rows))
    return folder


def assert_observed(recording, world, atol):
    """The points are where the pixels that observe them are."""
    points = recording.points
    seen = points.points_m[points.indices][:, None]
    local = transform(invert(world.poses)[points.frames], seen)[:, 0]
    pixels = np.stack(project(recording.intrinsics_px, local), axis=1)
    np.testing.assert_allclose(pixels, points.pixels_px, atol=atol)


@pytest.mark.parametrize("binary", [True, False])
def test_cameras_points_and_observations_are_those_of_the_scene(world, tmp_path, imported, binary):
    write_model(tmp_path / "room", world, binary=binary)
    done, problems = imported(Colmap(source=tmp_path / "room", fps=10.0))
    assert not problems
    recording = done["room"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-9)
    np.testing.assert_allclose(recording.intrinsics_px, world.intrinsics, atol=1e-9)
    assert not recording.metric
    world.assert_first(recording)
    points = recording.points
    assert len(points.points_m) == len(POINTS)
    assert points.error_px[0] == 0.25
    assert len(points.frames) == world.frames * len(POINTS)
    assert_observed(recording, world, atol=1e-3)


def test_images_of_a_radial_lens_are_remapped_and_so_are_observations(world, tmp_path, imported):
    write_model(
        tmp_path / "room", world, binary=True, model="OPENCV", distortion=(-0.2, 0.03, 0, 0)
    )
    recording = imported(Colmap(source=tmp_path / "room", fps=10.0))[0]["room"]
    assert recording.provenance["lens"] == "remapped"
    assert_observed(recording, world, atol=2e-3)


def test_several_cameras_and_unknown_models_are_refused(world, tmp_path, imported):
    write_model(tmp_path / "two", world, binary=True, cameras=2, spread=0.02)
    assert "single_camera" in imported(Colmap(source=tmp_path / "two", fps=10.0))[1]["two"]
    assert "--fps" in imported(Colmap(source=tmp_path / "two", fps=0.0))[1]["two"]
    write_model(tmp_path / "fov", world, binary=False, model="FOV", distortion=(0.9,))
    assert "FOV is not read" in imported(Colmap(source=tmp_path / "fov", fps=10.0))[1]["fov"]


@pytest.mark.parametrize("spread", [0.0, 0.0008])
def test_equal_cameras_are_one(world, tmp_path, imported, spread):
    write_model(tmp_path / "vggt", world, binary=True, cameras=12, spread=spread)
    recording = imported(Colmap(source=tmp_path / "vggt", fps=10.0))[0]["vggt"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-9)
    np.testing.assert_allclose(
        recording.intrinsics_px[0, 0], world.intrinsics[0, 0] * (1 + 5.5 * spread)
    )


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_truncated_file_or_a_false_count_is_refused(world, tmp_path, name):
    folder = write_model(tmp_path / "room", world, binary=True)
    data = (folder / name).read_bytes()
    for damaged in (data[: len(data) // 2], data[:-1], b"", struct.pack("<Q", 1 << 60) + data[8:]):
        (folder / name).write_bytes(damaged)
        with pytest.raises(InputError, match="is damaged"):
            read_model(folder)


@pytest.mark.parametrize("binary", [True, False])
def test_a_rotation_of_zeros_is_refused(world, tmp_path, binary):
    folder = write_model(tmp_path, world, binary=binary)
    if binary:
        data = (folder / "images.bin").read_bytes()
        (folder / "images.bin").write_bytes(data[:12] + bytes(32) + data[44:])
    else:
        lines = (folder / "images.txt").read_text().splitlines()
        first = next(n for n, line in enumerate(lines) if line and not line.startswith("#"))
        words = lines[first].split()
        lines[first] = " ".join([words[0], "0", "0", "0", "0", *words[5:]])
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="is not a rotation"):
        read_model(folder)


def test_a_camera_without_a_size_is_refused(world, tmp_path):
    folder = write_model(tmp_path, world, binary=False)
    text = (folder / "cameras.txt").read_text()
    (folder / "cameras.txt").write_text(text.replace(f" {world.width} ", " -4 ", 1))
    with pytest.raises(InputError, match="impossible image size"):
        read_model(folder)


def test_a_name_that_leaves_the_folder_of_images_is_not_found(world, tmp_path, imported):
    folder = write_model(tmp_path / "room", world, binary=False)
    text = (folder / "images.txt").read_text()
    (folder / "images.txt").write_text(text.replace("frame_", "../images/frame_"))
    assert (
        "none of the model's 12" in imported(Colmap(source=tmp_path / "room", fps=10.0))[1]["room"]
    )


def test_models_of_colmap_itself_are_read_as_it_reads_them(tmp_path):
    """COLMAP makes a scene and writes it in both formats, in a process without cv2."""
    program = (
        "import json, sys, numpy as np, pycolmap\n"
        "options = pycolmap.SyntheticDatasetOptions()\n"
        "options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 25\n"
        "model = pycolmap.synthesize_dataset(options)\n"
        "model.write_binary(sys.argv[1]); model.write_text(sys.argv[2])\n"
        "images = {i.name: i.cam_from_world().inverse().matrix().tolist()\n"
        "          for i in model.images.values()}\n"
        "camera = model.cameras[1]\n"
        "points = {n: [*p.xyz.tolist(), p.error] for n, p in model.points3D.items()}\n"
        "rays = [np.array([x, y, 1.0]) for x, y in json.load(sys.stdin)]\n"
        "seen = [camera.img_from_cam(ray).tolist() for ray in rays]\n"
        "print(json.dumps([images, points, seen]))\n"
    )
    folders = [tmp_path / "binary", tmp_path / "text"]
    for folder in folders:
        folder.mkdir()
    rays = [[0.1, -0.2], [0.3, 0.2], [0.0, 0.0]]
    run = subprocess.run(
        [sys.executable, "-c", program, *map(str, folders)],
        input=json.dumps(rays),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.returncode == 0, run.stderr
    images, points, seen = json.loads(run.stdout)
    for folder in folders:
        model = read_model(folder)
        assert {image.name for image in model.images} == images.keys()
        for image in model.images:
            pose = invert(image.camera_from_world)[:3]
            np.testing.assert_allclose(pose, images[image.name], atol=1e-9)
        found = np.column_stack([model.points, model.error_px])
        expected = [points[number] for number in sorted(points, key=int)]
        np.testing.assert_allclose(found, expected, atol=1e-9)
        pixels = make_lens(model.cameras[1]).project(np.array([[*ray, 1.0] for ray in rays]))
        np.testing.assert_allclose(pixels + 0.5, seen, atol=1e-9)
