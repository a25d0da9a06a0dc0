"""nerfstudio: OpenGL's axes, per-frame and common intrinsics, depth, and hostile paths."""

import json

import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.types import InputError

FLIP = np.diag([1.0, -1, -1, 1])


def write_capture(root, world, *, per_frame=False, frame_changes=None, depth=False, **changes):
    (fx, _, cx), (_, fy, cy), _ = world.intrinsics.tolist()
    camera = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": world.width,
              "h": world.height}  # fmt: skip
    frames = []
    (root / "images").mkdir(parents=True)
    for number, frame in enumerate(world.video):
        name = f"images/frame_{number}.png"
        Image.fromarray(frame).save(root / name)
        entry = {"file_path": name, "transform_matrix": (world.poses[number] @ FLIP).tolist()}
        if depth:
            Image.fromarray(np.full((12, 16), 900, np.uint16)).save(root / f"{number}.png")
            entry["depth_file_path"] = f"{number}.png"
        frames.append({**entry, **(camera if per_frame else {}), **(frame_changes or {})})
    frames = [frames[n] for n in np.random.default_rng(0).permutation(len(frames))]
    written = {
        "camera_model": "OPENCV",
        "frames": frames,
        **({} if per_frame else camera),
        **changes,
    }
    (root / "transforms.json").write_text(json.dumps(written))


def test_a_distorted_capture_is_remapped_and_its_depth_left_unknown(world, tmp_path, imported):
    write_capture(tmp_path / "desk", world, k1=-0.15, k2=0.02, depth=True)
    recording = imported(Nerfstudio(source=tmp_path / "desk", fps=10.0))[0]["desk"]
    assert recording.provenance["lens"] == "remapped"
    assert recording.depth is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame_changes": {"file_path": "../secret.png"}}, "inside the dataset"),
        ({"frame_changes": {"file_path": "/etc/passwd"}}, "inside the dataset"),
        ({"frame_changes": {"file_path": 3}}, "inside the dataset"),
        ({"frame_changes": {"transform_matrix": [[1, 2], [3]]}}, "4 x 4"),
        ({"frame_changes": {"transform_matrix": np.full((4, 4), np.nan).tolist()}}, "rigid"),
        ({"frame_changes": {"transform_matrix": (2 * np.eye(4)).tolist()}}, "rigid"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"fl_x": "wide"}, "fl_x"),
        ({"w": 64}, "calibrated for 64x96"),
        ({"frames": []}, "frames must be"),
        ({"frames": [7]}, "frame 0"),
    ],
)
def test_invalid_captures_are_named(world, tmp_path, imported, changes, message):
    write_capture(tmp_path / "desk", world, **changes)
    done, problems = imported(Nerfstudio(source=tmp_path / "desk", fps=10.0))
    assert not done
    assert message in problems["desk"]


def test_a_folder_without_transforms_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no transforms\.json"):
        list(Nerfstudio(source=tmp_path, fps=10.0).find())
