"""HOT3D: fisheye to upright pinhole, hands of UmeTrack's model, and damaged clips."""

import io
import json
import tarfile
import tracemalloc

import cv2
import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.data.readers.lenses import Lens
from egosim_jax.data.readers.umetrack import ORDER, HandModel
from egosim_jax.geometry import invert, project, transform
from egosim_jax.types import InputError
from tests.captures import quaternions

SIZE, FOCAL, FRAMES = 128, 56.0, 3
COEFFICIENTS = [0.4, -0.47, 0.08, 1.2, -1.6, 0.6, 2e-4, -6e-5, -1e-4, -1e-5, 6e-5, 2e-5]


def make_shape():
    """A rigid hand of 21 landmarks in millimeters, each on the wrist, and hinges along x."""
    rng = np.random.default_rng(0)
    return {
        "joint_rotation_axes": np.tile([1.0, 0, 0], (22, 1)).tolist(),
        "joint_rest_positions": rng.uniform(-40, 40, (22, 3)).tolist(),
        "landmark_rest_positions": rng.uniform(-40, 40, (21, 3)).tolist(),
        "landmark_rest_bone_weights": np.tile([1.0, 0, 0], (21, 1)).tolist(),
        "landmark_rest_bone_indices": np.zeros((21, 3), int).tolist(),
    }


def transform_json(pose):
    x, y, z, w = quaternions([pose[:3, :3]])[0].tolist()
    return {"quaternion_wxyz": [w, x, y, z], "translation_xyz": pose[:3, 3].tolist()}


def wrist(side):
    pose = np.eye(4)
    pose[:3, 3] = [0.05 if side else -0.05, 0.02, 0.4]
    return pose


def make_poses():
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(FRAMES)
    return poses


def write_clip(path, *, shapes=True, stream="214-1", model="FISHEYE624", focal=FOCAL):
    """Write a clip whose images show a white dot at each keypoint of the left hand."""
    lens = Lens(
        model="fisheye624",
        coefficients=tuple(COEFFICIENTS),
        intrinsics_px=np.array([[FOCAL, 0, 63.0], [0, FOCAL, 64.5], [0, 0, 1]]),
        height=SIZE,
        width=SIZE,
    )
    shape = HandModel.from_json(make_shape())
    points = shape.keypoints(np.zeros(22), wrist(0), 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, "w") as tar:

        def add(name, data):
            data = data if isinstance(data, bytes) else json.dumps(data).encode()
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))

        if shapes:
            add("__hand_shapes.json__", {"mano": [0.0] * 10, "umetrack": make_shape()})
        for frame, pose in enumerate(make_poses()):
            key = f"{frame:06d}"
            calibration = {
                "projection_model_type": f"CameraModelType.{model}",
                "projection_params": [focal, 63.0, 64.5, *COEFFICIENTS],
                "image_width": SIZE,
                "image_height": SIZE,
                "label": "camera-rgb",
                "serial_number": "0",
                "T_device_from_camera": transform_json(np.eye(4)),
            }
            camera = {"T_world_from_camera": transform_json(pose), "calibration": calibration}
            add(f"{key}.cameras.json", {stream: camera})
            hands = {}
            for side, label in enumerate(("left", "right")):
                hand = {
                    "T_world_from_wrist": transform_json(wrist(side)),
                    "joint_angles": [0.0] * 22,
                }
                hands[label] = {"umetrack_pose": hand}
            add(f"{key}.hands.json", {"left": hands["left"]} if frame == 2 else hands)
            add(
                f"{key}.info.json", {"image_timestamps_ns": {stream: round(1e9 + frame * 1e9 / 30)}}
            )
            image = np.zeros((SIZE, SIZE, 3), np.uint8)
            for x, y in lens.project(transform(invert(pose), points)):
                cv2.circle(image, (round(x), round(y)), 2, (255, 255, 255), -1)
            data = io.BytesIO()
            Image.fromarray(image).save(data, "JPEG", quality=95)
            add(f"{key}.image_{stream}.jpg", data.getvalue())


def test_keypoints_are_where_the_turned_pinhole_projects_them(tmp_path, imported):
    write_clip(tmp_path / "set/clip-000001.tar")
    done, problems = imported(Hot3D(source=tmp_path / "set"))
    assert not problems
    recording = done["clip-000001"]
    assert (recording.frames, recording.fps) == (FRAMES, 30)
    assert recording.metric
    local = transform(invert(recording.world_from_camera[:, None]), recording.joints_m)
    u, v = project(recording.intrinsics_px, local)
    images = recording.read_frames().frames
    for frame in range(FRAMES):
        for x, y in zip(u[frame, 0], v[frame, 0], strict=True):
            assert images[frame, round(y), round(x), 0] > 150


def test_the_image_is_turned_clockwise_and_a_hand_without_annotation_is_missing(tmp_path, imported):
    """The color camera's x axis points up: objects to its right appear below."""
    write_clip(tmp_path / "set/clip.tar")
    recording = imported(Hot3D(source=tmp_path / "set"))[0]["clip"]
    np.testing.assert_allclose(recording.world_from_camera[0, :3, 1], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(recording.world_from_camera[0, :3, 2], [0, 0, 1], atol=1e-9)
    missing = np.isnan(recording.joints_m).any(axis=(2, 3))
    assert missing[2, 1]
    assert missing.sum() == 1


def test_a_clip_without_shapes_has_no_hands(tmp_path, imported):
    write_clip(tmp_path / "set/clip.tar", shapes=False)
    assert imported(Hot3D(source=tmp_path / "set"))[0]["clip"].joints_m is None


def test_a_gray_stream_is_chosen_and_not_turned(tmp_path, imported):
    write_clip(tmp_path / "set/clip.tar", stream="1201-1")
    assert "--stream" in imported(Hot3D(source=tmp_path / "set"))[1]["clip"]
    recording = imported(Hot3D(source=tmp_path / "set", stream="1201-1"))[0]["clip"]
    np.testing.assert_allclose(recording.world_from_camera[0], np.eye(4), atol=1e-9)


def test_damaged_clips_are_named(tmp_path, imported):
    source = tmp_path / "set"
    write_clip(source / "good.tar")
    write_clip(source / "model.tar", model="KANNALA_BRANDT_K3")
    write_clip(source / "nan.tar", focal=float("nan"))
    (source / "cut.tar").write_bytes((source / "good.tar").read_bytes()[:5000])
    (source / "text.tar").write_text("nothing" * 200)
    with tarfile.open(source / "link.tar", "w") as tar:
        link = tarfile.TarInfo("000000.cameras.json")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(link)
    done, problems = imported(Hot3D(source=source))
    assert list(done) == ["good"]
    assert "KANNALA_BRANDT_K3" in problems["model"]
    assert "finite numbers" in problems["nan"]
    assert problems.keys() == {"model", "nan", "cut", "text", "link"}


def test_a_hinge_turns_what_follows_it_and_the_right_hand_is_mirrored():
    written = make_shape()
    bones = np.zeros((21, 3), int)
    bones[1] = 2 + 3 * 1 + 2  # the tip of the index finger follows the last frame of finger 1
    written["landmark_rest_bone_indices"] = bones.tolist()
    model = HandModel.from_json(written)
    angles = np.zeros(22)
    angles[7] = 0.5  # the last hinge of finger 1
    moved = model.keypoints(angles, np.eye(4), 0)
    rest = np.array(written["landmark_rest_positions"]) / 1000
    pivot = np.array(written["joint_rest_positions"])[7] / 1000
    turn = cv2.Rodrigues(np.array([0.5, 0, 0]))[0]
    np.testing.assert_allclose(moved[8], turn @ (rest[1] - pivot) + pivot, atol=1e-12)
    np.testing.assert_allclose(moved[0], rest[5], atol=1e-12)
    np.testing.assert_allclose(moved[1], np.array(written["joint_rest_positions"])[0] / 1000)
    assert sorted(ORDER) == list(range(-1, 20))
    mirrored = model.keypoints(angles, np.eye(4), 1)
    np.testing.assert_allclose(mirrored, moved * [-1, 1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("joint_rotation_axes", [[1, 0, 0]] * 5),
        ("landmark_rest_positions", "none"),
        ("landmark_rest_bone_indices", [[99] * 3] * 21),
        ("landmark_rest_bone_weights", [[1.0]] * 21),
    ],
)
def test_an_invalid_shape_is_refused(name, value):
    with pytest.raises(InputError, match="hand model"):
        HandModel.from_json(make_shape() | {name: value})


def sparse(info):
    """Headers of a sparse file whose map is damaged, or larger than the file."""
    return [
        {"GNU.sparse.major": "1", "GNU.sparse.minor": "0", "GNU.sparse.name": info.name},
        {"GNU.sparse.map": "0,x", "GNU.sparse.size": "9"},
        {"GNU.sparse.size": "1099511627776", "GNU.sparse.map": "0,512"},
        {"GNU.sparse.size": "-1", "GNU.sparse.numblocks": "1", "GNU.sparse.offset": "x"},
        {"size": "-5"},
    ]


@pytest.mark.parametrize("number", range(5))
def test_headers_that_tarfile_does_not_expect_are_refused(tmp_path, imported, number):
    source = tmp_path / "set"
    source.mkdir()
    with tarfile.open(source / "a.tar", "w", format=tarfile.PAX_FORMAT) as tar:
        info = tarfile.TarInfo("000000.cameras.json")
        info.pax_headers, info.size = sparse(info)[number], 600
        tar.addfile(info, io.BytesIO(b"x" * 600))
    assert "a.tar" in imported(Hot3D(source=source))[1]["a"]


def test_the_headers_of_all_members_are_not_copied_to_each(tmp_path, imported):
    source = tmp_path / "set"
    source.mkdir()
    headers = {f"comment.{number}": "x" for number in range(2000)}
    with tarfile.open(source / "a.tar", "w", format=tarfile.PAX_FORMAT, pax_headers=headers) as tar:
        for number in range(2000):
            tar.addfile(tarfile.TarInfo(f"{number}"))
    tracemalloc.start()
    try:
        assert "not a HOT3D clip" in imported(Hot3D(source=source))[1]["a"]
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()
