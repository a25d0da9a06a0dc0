"""Static triplets from scenes, fixed cameras, keypoints and MANO; mixing and aligning."""

import json
from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.cli.triplets import Align, Mix, Static, ToDwm
from egosim_jax.data.clips import load_triplet
from egosim_jax.data.dwm import write_folders
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.mixing import open_shards
from egosim_jax.data.pack import pack
from egosim_jax.geometry import rotation_z
from egosim_jax.io.video import probe_video, read_video
from egosim_jax.io.writing import write_video
from egosim_jax.state.snapshot import save, write_ply
from egosim_jax.types import InputError, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_triplet
from egosim_jax.worlds.tabletop.clips import hand_video, static_video
from tests.mano import model_pickle, random_model

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)
FILES = {"height": 48, "width": 80, "video_id": "own"}


@pytest.fixture(scope="module")
def clip():
    return next(make_sequence(3, spec=SPEC))


@pytest.fixture
def action(clip, tmp_path):
    """File of the clip's cameras and hands, left before right."""
    joints = np.full((5, 2, 21, 3), np.nan)
    for number, side in enumerate(clip.sides):
        joints[:, ("left", "right").index(side)] = clip.joints_m[:, number]
    path = tmp_path / "action.json"
    values = {
        "world_from_camera": clip.cameras.world_from_camera.tolist(),
        "intrinsics_px": clip.cameras.intrinsics_px.tolist(),
        "joints_m": np.where(np.isnan(joints), None, joints).tolist(),
        "prompt": clip.caption,
    }
    path.write_text(json.dumps(values), "utf-8")
    return path


@pytest.fixture
def fixed(action):
    """File of those cameras and hands with the first camera in all frames."""
    values = json.loads(action.read_text("utf-8"))
    values["world_from_camera"] = [values["world_from_camera"][0]] * 5
    path = action.with_name("fixed.json")
    path.write_text(json.dumps(values), "utf-8")
    return path


def made(path) -> Triplet:
    (files,) = read_metadata(path)
    return load_triplet(files, SPEC)


def near(video, other, most=8):
    return np.abs(video.astype(int) - other).mean() < most


def test_a_state_gives_the_triplet_of_its_clip(clip, action, tmp_path, capsys):
    save(tmp_path / "state", clip.state)
    write_video(tmp_path / "clip.mp4", clip.frames, 8)
    command = Static(
        action=action,
        out=tmp_path / "out",
        scene=tmp_path / "state",
        video=tmp_path / "clip.mp4",
        **FILES,
    )
    assert command.run() == 0
    triplet = made(tmp_path / "out" / "metadata.csv")
    expected = to_triplet(clip, point_px=2)
    assert str(tmp_path / "out") in capsys.readouterr().out
    assert near(triplet.prior, expected.prior)
    assert near(triplet.hands, hand_video(clip))
    assert near(triplet.target, clip.frames)
    assert triplet.prompt == clip.caption
    write_ply(tmp_path / "state.ply", clip.state)
    again = replace(command, scene=tmp_path / "state.ply", out=tmp_path / "again")
    assert again.run() == 0
    assert near(made(tmp_path / "again" / "metadata.csv").prior, expected.prior)


def write_mesh(path, vertices, colors, faces):
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    points = np.empty(len(vertices), [("p", "<f4", 3), ("c", "u1", 3)])
    points["p"], points["c"] = vertices, colors
    data = b"".join(bytes([len(f)]) + np.array(f, "<i4").tobytes() for f in faces)
    path.write_bytes("\n".join([*lines, ""]).encode() + points.tobytes() + data)
    return path


def test_a_mesh_is_drawn_in_the_colors_of_its_vertices(clip, action, tmp_path):
    table = np.array([[-3, -1, 0], [3, -1, 0], [3, 3, 0], [-3, 3, 0]])
    colors = np.array([[0, 40, 100], [240, 40, 100], [240, 40, 100], [0, 40, 100]])
    mesh = write_mesh(tmp_path / "mesh.ply", table, colors, [[0, 1, 2], [0, 2, 3]])
    assert Static(action=action, out=tmp_path / "out", scene=mesh, **FILES).run() == 0
    triplet = made(tmp_path / "out" / "metadata.csv")
    # Where the clip shows the table, x = -3 has no red and x = 3 all of it.
    rows, columns = np.nonzero(clip.ids[0] == 1)
    pose, matrix = clip.cameras.world_from_camera[0], clip.cameras.intrinsics_px
    ways = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(matrix).T
    x = pose[0, 3] + (clip.depth_m[0][rows, columns, None] * ways @ pose[:3, :3].T)[:, 0]
    expected = np.stack([240 * (x + 3) / 6, np.full_like(x, 40), np.full_like(x, 100)], axis=-1)
    on_table = np.abs(triplet.prior[0][rows, columns] - expected).max(axis=-1)
    assert np.median(on_table) < 4
    assert triplet.mask.max() == 0 or (triplet.mask > 127).mean() < 0.9


def test_a_moving_camera_needs_a_scene(clip, action, fixed, tmp_path):
    write_video(tmp_path / "clip.mp4", clip.frames, 8)
    values = json.loads(fixed.read_text("utf-8"))
    values["world_from_camera"][3][1][3] += 0.25
    moved, turned = tmp_path / "moved.json", tmp_path / "turned.json"
    moved.write_text(json.dumps(values), "utf-8")
    values["world_from_camera"][3] = values["world_from_camera"][0]
    rotated = np.array(values["world_from_camera"][4])
    rotated[:3, :3] = rotated[:3, :3] @ rotation_z(np.radians(3))
    values["world_from_camera"][4] = rotated.tolist()
    turned.write_text(json.dumps(values), "utf-8")
    for path, message in (
        (action, "moves by up to"),
        (moved, r"by up to 0\.250 m and turns by up to 0\.0 degrees\. .*\(--scene\)"),
        (turned, r"by up to 0\.000 m and turns by up to 3\.0 degrees"),
    ):
        with pytest.raises(InputError, match=message):
            Static(action=path, out=tmp_path, video=tmp_path / "clip.mp4", **FILES).run()


def test_a_fixed_camera_repeats_the_first_frame(clip, fixed, tmp_path):
    write_video(tmp_path / "clip.mp4", clip.frames, 8)
    files = {"action": fixed, "out": tmp_path / "out", **FILES}
    assert Static(video=tmp_path / "clip.mp4", **files).run() == 0
    triplet = made(tmp_path / "out" / "metadata.csv")
    assert near(triplet.prior, clip.frames[:1].repeat(5, axis=0))
    with pytest.raises(InputError, match="There is no scene"):
        Static(**files).run()
    with pytest.raises(InputError, match="--fps must be at least 1, not 0"):
        Static(video=tmp_path / "clip.mp4", fps=0, **files).run()
    write_video(tmp_path / "short.mp4", clip.frames[:4], 8)
    message = (
        r"recorded video .* must be uint8 \(5, 48, 80, 3\)\. Cut or resize .*\(--video, --action"
    )
    with pytest.raises(InputError, match=message):
        Static(video=tmp_path / "short.mp4", **files).run()


def test_folders_of_dwm_keep_the_frame_rate_of_their_shards(clip, tmp_path):
    twin = to_triplet(clip, prior="static", hands="mesh")
    twins = [replace(twin, video_id=name) for name in ("a", "b")]
    items = read_metadata(write_folders(tmp_path / "root", twins, name="s", fps=24))
    packed = {"videos": (None, "first"), "frames": (SPEC, "stride"), "rate": (SPEC, "rate")}
    again = items[0].target, items[0].prior, items[0].hands
    for name, (spec, rule) in packed.items():
        if name == "rate":  # whose shorter clips have every third frame
            for path in again:
                write_video(path, read_video(path).frames.repeat(3, axis=0)[:13], 24)
            items = items[:1]
        shards = tmp_path / name
        list(pack(items, out=shards, spec=spec, provenance={}, resampling=rule))

    def rate(name, **options):
        out = tmp_path / "out"
        assert ToDwm(shards=tmp_path / name, out=out, name=name, **options).run() == 0
        return probe_video(read_metadata(out / "dataset_files" / f"{name}.txt")[0].target).fps

    assert rate("videos") == 24
    assert rate("rate") == 8
    assert rate("frames", fps=12) == 12
    with pytest.raises(InputError, match="have no frame rate: give it"):
        rate("frames")
    for name, have in (("videos", 24), ("rate", 8)):
        with pytest.raises(InputError, match=f"have {have} frames per second, not 30"):
            rate(name, fps=30)


def test_hands_of_mano_replace_those_of_keypoints(clip, fixed, tmp_path):
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(model_pickle(random_model()))
    write_video(tmp_path / "clip.mp4", clip.frames, 8)
    poses = {
        "global_orient": np.zeros((5, 2, 3)),
        "hand_pose": np.zeros((5, 2, 45)),
        "translation_m": np.full((5, 2, 3), [0.0, 0.25, 0.05]),
        "betas": np.zeros((2, 10)),
    }
    for name in ("global_orient", "hand_pose", "translation_m"):
        poses[name][:, 0] = np.nan
    np.savez(tmp_path / "poses.npz", **poses)
    files = {"action": fixed, "out": tmp_path / "out", "video": tmp_path / "clip.mp4", **FILES}
    mano = {"mano_right": tmp_path / "MANO_RIGHT.pkl", "mano_poses": tmp_path / "poses.npz"}
    assert Static(**files, **mano).run() == 0
    hands = made(tmp_path / "out" / "metadata.csv").hands[0].astype(int)
    drawn = hands[hands.sum(axis=-1) > 150]
    assert len(drawn) > 5
    assert (drawn[:, 0] > drawn[:, 1]).mean() > 0.9  # only the right hand, in red
    with pytest.raises(InputError, match="give both"):
        Static(**files, mano_right=mano["mano_right"]).run()
    with pytest.raises(InputError, match="give both"):
        Static(**files, add_mean=True).run()
    np.savez(tmp_path / "poses.npz", **{n: v[:4] if n != "betas" else v for n, v in poses.items()})
    with pytest.raises(InputError, match="hands have 4 frames, the cameras 5"):
        Static(**files, **mano).run()


def test_shards_become_folders_of_dwm_are_mixed_and_aligned(clip, tmp_path, capsys):
    twin = to_triplet(clip, prior="static", hands="mesh")
    path = write_folders(tmp_path / "root", [replace(twin, video_id="0")], name="a", fps=8)
    for name in ("one", "two"):
        list(pack(read_metadata(path), out=tmp_path / name, spec=SPEC, provenance={}))
    assert ToDwm(shards=tmp_path / "one", out=tmp_path / "again", name="b", fps=8).run() == 0
    written = tmp_path / "again" / "dataset_files" / "b.txt"
    assert near(load_triplet(read_metadata(written)[0], SPEC).prior, static_video(clip))
    parts = tmp_path / "one", tmp_path / "two"
    assert Mix(shards=parts, weights=(3.0, 1.0), out=tmp_path / "mixed").run() == 0
    assert open_shards(tmp_path / "mixed").weights == (3.0, 1.0)
    with pytest.raises(InputError, match="1 weights for 2 folders"):
        Mix(shards=parts, weights=(3.0,), out=tmp_path / "mixed").run()
    results = tmp_path / "aligned.json"
    assert Align(metadata=path, most_px=4, out=results).run() == 0
    (result,) = json.loads(results.read_text("utf-8"))["clips"].values()
    assert result["shift_px"] == [0, 0]
    assert result["gain"] == 0
    assert "a_videos_0" in capsys.readouterr().out
