"""A link out of the source is not followed, by any reader, and a pipe is named."""

import json
import os
import shutil

import numpy as np
import pytest

from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.data.readers.taste_rob import TasteRob
from tests.unit.data.readers.test_egosim import write_clip
from tests.unit.data.readers.test_hot3d import write_clip as write_tar
from tests.unit.data.readers.test_record3d import write_capture


def egosim(folder, world):
    write_clip(folder / "fold", world)
    return EgoSimClips(source=folder)


def record3d(folder, world):
    write_capture(folder / "scan.r3d", world)
    shutil.unpack_archive(folder / "scan.r3d", folder / "room", "zip")
    (folder / "scan.r3d").unlink()
    return Record3D(source=folder / "room")


def hot3d(folder, world):
    write_tar(folder / "clip-1.tar")
    return Hot3D(source=folder)


def nerfstudio(folder, world):
    (folder / "images").mkdir()
    frames = []
    for number, pose in enumerate(world.poses):
        np.save(folder / "images" / f"{number}.npy", 0)
        frames.append({"file_path": f"images/{number}.npy", "transform_matrix": pose.tolist()})
    fields = {"fl_x": 9, "fl_y": 9, "cx": 4, "cy": 4, "w": 8, "h": 8, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(fields))
    return Nerfstudio(source=folder, fps=30.0)


def taste_rob(folder, world):
    world.write_video(folder / "a.mp4", fps=16)
    (folder / "table.csv").write_text("video,caption\na.mp4,Fold it.\n")
    return TasteRob(source=folder)


CASES = [
    (egosim, "fold/caption.txt"),
    (egosim, "fold/_proc/poses_da3/fold/depth_000000.npy"),
    (record3d, "room/rgbd/3.jpg"),
    (hot3d, "clip-1.tar"),
    (nerfstudio, "images/0.npy"),
    (taste_rob, "a.mp4"),
]


@pytest.mark.parametrize("kind", ["link", "pipe"])
@pytest.mark.parametrize(
    ("make", "name"), CASES, ids=[f"{make.__name__} {name}" for make, name in CASES]
)
def test_a_link_out_of_the_source_or_a_pipe_is_refused(world, tmp_path, imported, make, name, kind):
    folder = tmp_path / "set"
    folder.mkdir()
    reader = make(folder, world)
    path, secret = folder / name, tmp_path / f"secret{(folder / name).suffix}"
    path.rename(secret)
    path.symlink_to(secret) if kind == "link" else os.mkfifo(path)
    done, problems = imported(reader)
    assert not done
    (problem,) = problems.values()
    reason = {"link": "link to a file outside of the source", "pipe": "is not a regular file"}
    assert reason[kind] in problem
    assert path.name in problem


def test_links_inside_the_source_and_a_source_that_is_a_link_are_followed(
    world, tmp_path, imported
):
    egosim(tmp_path / "set", world)
    caption = tmp_path / "set" / "fold" / "caption.txt"
    caption.rename(caption.with_name("text.txt"))
    caption.symlink_to("text.txt")
    (tmp_path / "linked").symlink_to(tmp_path / "set")
    done, problems = imported(EgoSimClips(source=tmp_path / "linked"))
    assert not problems
    assert done["fold"].caption
