"""Recordings have the frames, cameras and hands that were written, of every dataset.

The tests of the readers have the same recordings with faults.
"""

from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.data.readers.agibot import AgiBot
from egosim_jax.data.readers.colmap import Colmap
from egosim_jax.data.readers.egodex import EgoDex
from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.egovid import EgoVid
from egosim_jax.data.readers.lerobot import LeRobot
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.data.readers.taste_rob import TasteRob
from tests.captures import FRAMES, coded, shown
from tests.unit.data.readers import test_lerobot as lerobot_files
from tests.unit.data.readers.test_agibot import write_episode as write_agibot
from tests.unit.data.readers.test_colmap import write_model
from tests.unit.data.readers.test_egodex import write_episode as write_egodex
from tests.unit.data.readers.test_egosim import write_clip, write_hands
from tests.unit.data.readers.test_egovid import UUID, write_set
from tests.unit.data.readers.test_nerfstudio import write_capture as write_nerfstudio
from tests.unit.data.readers.test_record3d import write_capture as write_record3d

HAND_M = 0.01
"""HaMeR's file has a hand's place only as pixels and a size."""


def agibot(folder, world):
    write_agibot(folder / "set", world)
    return AgiBot(source=folder / "set")


def agibot_with_a_lens(folder, world):
    lens = {"k1": -0.05, "k2": 0.01, "p1": 0.0, "p2": 0.0, "k3": 0.0}
    world.video[:] = coded(FRAMES, 1, 1)
    write_agibot(folder / "set", world, lens=lens)
    return AgiBot(source=folder / "set")


def colmap(folder, world, *, binary):
    write_model(folder / "room", world, binary=binary)
    return Colmap(source=folder / "room", fps=10.0)


def egodex(folder, world):
    write_egodex(world, folder / "set/part1/fold/0.hdf5")
    return EgoDex(source=folder / "set")


def egosim(folder, world):
    write_clip(folder / "set/fold_1", world)
    write_hands(folder / "set/fold_1", world)
    return EgoSimClips(source=folder / "set")


def egovid(folder, world):
    write_set(folder / "set", world, video=UUID, span=(3, 9), poses=world.poses[:2])
    return EgoVid(source=folder / "set")


def lerobot(folder, world):
    root = folder / "set"
    lerobot_files.write_v3(root, world)
    frames = [*range(7), *range(5)]
    rows = {
        "timestamp": pa.array(np.array(frames, np.float32) / np.float32(30)),
        "frame_index": frames,
        "episode_index": [0] * 7 + [1] * 5,
        "index": list(range(FRAMES)),
        "task_index": [0] * 7 + [1] * 5,
    }
    pq.write_table(pa.table(rows), root / "data/chunk-000/file-000.parquet")
    return LeRobot(source=root)


def nerfstudio(folder, world, *, per_frame):
    write_nerfstudio(folder / "desk", world, per_frame=per_frame, depth=True)
    return Nerfstudio(source=folder / "desk", fps=10.0, metric=True)


def record3d(folder, world):
    write_record3d(folder / "scan.r3d", world)
    return Record3D(source=folder / "scan.r3d")


def taste_rob(folder, world):
    world.write_video(folder / "set/clips/a.mp4", fps=25)
    (folder / "set/list.csv").write_text('File_Name,caption\nclips/a.mp4,"Lift it, wait"\n')
    return TasteRob(source=folder / "set")


CUP, TOWEL, LIFT = "Pick the cup", "Unfold the towel.", "Lift it, wait"
ONION = "The wearer cuts an onion, slowly."
DATASETS = [
    (agibot, 30, [(0, 5), (5, 12)], "metric cameras", [CUP, "Place the cup"]),
    (agibot_with_a_lens, 30, [(0, 5), (5, 12)], "metric cameras", [CUP, "Place the cup"]),
    (partial(colmap, binary=False), 10, [(0, 12)], "cameras points", [None]),
    (partial(colmap, binary=True), 10, [(0, 12)], "cameras points", [None]),
    (egodex, 30, [(0, 12)], "metric cameras joints names", [TOWEL]),
    (egosim, 16, [(0, 12)], "metric cameras joints depth", ["A person folds a towel."]),
    (egovid, 30, [(3, 9)], "names", [ONION]),
    (lerobot, 30, [(0, 7), (7, 12)], "", ["pick the cup", "place the cup; wait"]),
    (partial(nerfstudio, per_frame=False), 10, [(0, 12)], "metric cameras depth", [None]),
    (partial(nerfstudio, per_frame=True), 10, [(0, 12)], "metric cameras depth", [None]),
    (record3d, 60, [(0, 12)], "metric cameras", [None]),
    (taste_rob, 25, [(0, 12)], "fixed", [LIFT]),
]
NAMES = {egodex: ("towel", "table"), egovid: ("onion", "knife")}
DEPTH_M = {egosim: 0.7, nerfstudio: 0.9}


@pytest.mark.parametrize(("write", "fps", "spans", "facts", "captions"), DATASETS)
def test_a_recording_has_the_frames_cameras_hands_and_texts_that_were_written(
    write, fps, spans, facts, captions, world, tmp_path, imported
):
    recordings, problems = imported(write(tmp_path, world))
    assert not problems
    assert [read.caption for read in recordings.values()] == captions
    dataset = getattr(write, "func", write)
    for (start, stop), read in zip(spans, recordings.values(), strict=True):
        assert (read.fps, read.width, read.height) == (fps, world.width, world.height)
        assert shown(read.read_frames().frames, FRAMES) == list(range(start, stop))
        assert (read.metric, read.names) == ("metric" in facts, NAMES.get(write, ()))
        if "cameras" in facts:
            np.testing.assert_allclose(read.world_from_camera, world.poses[start:stop], atol=1e-6)
            np.testing.assert_allclose(read.intrinsics_px, world.intrinsics, atol=1e-4)
        else:
            poses = np.tile(np.eye(4), (FRAMES, 1, 1)) if "fixed" in facts else None
            np.testing.assert_equal(read.world_from_camera, poses)
        if "joints" in facts:
            tolerance = HAND_M if write is egosim else 1e-6
            np.testing.assert_allclose(read.joints_m, world.joints[start:stop], atol=tolerance)
        assert (read.points is not None) == ("points" in facts)
        if "depth" in facts:
            assert read.read_depth(0).shape == (world.height, world.width)
            assert read.read_depth(0)[5, 5] == pytest.approx(DEPTH_M[dataset])
            assert (read.read_depth(1) is None) == (write is egosim)
