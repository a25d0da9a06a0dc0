"""Clean recordings of every dataset that `egosim data import` reads."""

import json
import sys
import types
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.data.importing import import_recordings
from egosim_jax.data.readers.agibot import AgiBot
from egosim_jax.data.readers.colmap import Colmap
from egosim_jax.data.readers.egodex import EgoDex
from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.egovid import EgoVid
from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.data.readers.lerobot import LeRobot
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.data.readers.taste_rob import TasteRob
from egosim_jax.data.readers.trumans import Trumans
from egosim_jax.data.recording import Recording
from egosim_jax.types import InputError
from tests.captures import World
from tests.golden import fingerprints as fp
from tests.golden.fingerprints import clean
from tests.unit.data.readers import test_hot3d as hot3d_files
from tests.unit.data.readers import test_lerobot as lerobot_files
from tests.unit.data.readers.test_agibot import write_episode as write_agibot
from tests.unit.data.readers.test_colmap import write_model
from tests.unit.data.readers.test_egodex import write_episode as write_egodex
from tests.unit.data.readers.test_egosim import write_clip, write_hands
from tests.unit.data.readers.test_egovid import UUID, write_set
from tests.unit.data.readers.test_nerfstudio import write_capture as write_nerfstudio
from tests.unit.data.readers.test_record3d import write_capture as write_record3d


def imported(reader: Any, folder: Path, *, count: int | None = 12) -> fp.Fields:
    """Yield the facts of the recordings that a reader imports."""
    _, outcomes = import_recordings(reader, folder / "out")
    for outcome in outcomes:
        assert outcome.problem is None, outcome.problem
        found = Recording.load(folder / "out" / outcome.recording_id)
        yield from fp.under(outcome.recording_id, fp.recording(found, folder, count=count))


def coded_world(**size: int) -> World:
    """A scene whose frames are their numbers everywhere, so that a lens cannot hide them."""
    world = World(**size)
    world.video[:] = fp.coded(world.frames, 1, 1)
    return world


@clean("agibot", False)
@clean("agibot in one folder", True)
def agibot(folder, flat):
    world = World()
    write_agibot(folder / "set", world, flat=flat, parts=not flat)
    with h5py.File(next(folder.rglob("*.h5")), "a") as file:
        del file["timestamp"]
        file["timestamp"] = 1_700_000_000_000_000_000 + np.arange(world.frames) * 33_333_333
    return imported(AgiBot(source=folder / "set"), folder)


@clean("agibot with a lens")
def agibot_with_a_lens(folder):
    lens = {"k1": -0.05, "k2": 0.01, "p1": 0.0, "p2": 0.0, "k3": 0.0}
    write_agibot(folder / "set", coded_world(), lens=lens)
    return imported(AgiBot(source=folder / "set"), folder)


@clean("colmap text", False)
@clean("colmap binary", True)
def colmap(folder, binary):
    write_model(folder / "room", World(), binary=binary)
    return imported(Colmap(source=folder / "room", fps=10.0), folder)


@clean("colmap with a lens")
def colmap_with_a_lens(folder):
    lens = {"model": "OPENCV", "distortion": (-0.2, 0.03, 0, 0)}
    write_model(folder / "room", coded_world(), binary=True, **lens)
    return imported(Colmap(source=folder / "room", fps=29.97), folder)


@clean("egodex")
def egodex(folder):
    write_egodex(World(), folder / "set/part1/fold/0.hdf5")
    return imported(EgoDex(source=folder / "set"), folder)


@clean("egosim and hamer")
def egosim(folder):
    write_clip(folder / "set/fold_1", World())
    write_hands(folder / "set/fold_1", World())
    return imported(EgoSimClips(source=folder / "set"), folder)


@clean("egovid")
def egovid(folder):
    world = World(frames=20, height=240, width=320)
    world.render_plane()
    world.video[:, :8, :8] = fp.coded(20, 8, 8)
    write_set(folder / "set", world)
    return imported(EgoVid(source=folder / "set"), folder, count=20)


@clean("egovid in a long video")
def egovid_in_a_long_video(folder):
    world = World()
    write_set(folder / "set", world, video=UUID, span=(3, 9), poses=world.poses[:2])
    return imported(EgoVid(source=folder / "set"), folder)


@clean("hot3d and umetrack", "214-1")
@clean("hot3d gray", "1201-1")
def hot3d(folder, stream):
    hot3d_files.write_clip(folder / "set/clip-000001.tar", stream=stream)
    return imported(Hot3D(source=folder / "set", stream=stream), folder, count=None)


def lerobot_rows(lengths, fps, **columns):
    """Rows of LeRobot's tables for episodes of these lengths."""
    frames = [number for length in lengths for number in range(length)]
    episodes = [episode for episode, length in enumerate(lengths) for _ in range(length)]
    return pa.table({
        "timestamp": pa.array(np.array(frames, np.float32) / np.float32(fps)),
        "frame_index": frames,
        "episode_index": episodes,
        "index": list(range(len(frames))),
        "task_index": episodes,
        **columns,
    })  # fmt: skip


@clean("lerobot v2.0", "v2.0", 15)
@clean("lerobot v2.1", "v2.1", 30)
def lerobot_v2(folder, version, fps):
    root, world, name = folder / "set", World(), "episode_{episode_index:06d}"
    chunk = "chunk-{episode_chunk:03d}"
    paths = {
        "video_path": f"videos/{chunk}/{{video_key}}/{name}.mp4",
        "data_path": f"data/{chunk}/{name}.parquet",
    }
    lerobot_files.write_info(root, version, fps=fps, total_episodes=2, **paths)
    (root / "data/chunk-000").mkdir(parents=True)
    for number in range(2):
        key = lerobot_files.KEY
        world.write_video(root / f"videos/chunk-000/{key}/episode_{number:06d}.mp4", fps=fps)
        rows = lerobot_rows([world.frames], fps).to_pydict()
        rows |= {"episode_index": [number] * world.frames, "task_index": [number] * world.frames}
        pq.write_table(pa.table(rows), root / f"data/chunk-000/episode_{number:06d}.parquet")
    for name, items in {
        "tasks": [{"task_index": n, "task": f"Task {n}."} for n in range(2)],
        "episodes": [
            {"episode_index": n, "tasks": [f"Task {n}."], "length": world.frames} for n in range(2)
        ],
    }.items():
        text = "".join(json.dumps(item) + "\n" for item in items)
        (root / f"meta/{name}.jsonl").write_text(text, "utf-8")
    return imported(LeRobot(source=root), folder)


@clean("lerobot v3.0", True)
@clean("lerobot v3.0 with tasks of frames", False)
def lerobot_v3(folder, tasks):
    root = folder / "set"
    lerobot_files.write_v3(root, World(), tasks=tasks)
    pq.write_table(lerobot_rows([7, 5], 30), root / "data/chunk-000/file-000.parquet")
    return imported(LeRobot(source=root), folder)


@clean("nerfstudio")
def nerfstudio(folder):
    write_nerfstudio(folder / "desk", World(), depth=True)
    return imported(Nerfstudio(source=folder / "desk", fps=10.0, metric=True), folder)


@clean("nerfstudio with a lens")
def nerfstudio_with_a_lens(folder):
    write_nerfstudio(folder / "desk", coded_world(), per_frame=True, k1=-0.15, k2=0.02)
    return imported(Nerfstudio(source=folder / "desk", fps=10.0), folder)


@clean("record3d", False)
@clean("record3d exported", True)
def record3d(folder, exported):
    source = folder / "scan.r3d"
    write_record3d(source, World(), images="rgb" if exported else "rgbd")
    if exported:
        with zipfile.ZipFile(source) as archive:
            archive.extractall(folder / "scan")
        source.unlink()
        source = folder / "scan"
        (source / "metadata").rename(source / "metadata.json")
    lzfse = types.ModuleType("liblzfse")  # decompresses zlib, as the test's captures have it
    lzfse.decompress, lzfse.error = lambda data: zlib.decompress(data[12:-4]), zlib.error
    lzfse.__spec__ = types.SimpleNamespace(name="liblzfse")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "liblzfse", lzfse)
        return list(imported(Record3D(source=source), folder))


@clean("taste_rob")
def taste_rob(folder):
    for name in "ab":
        World().write_video(folder / f"set/clips/{name}.mp4", fps=25)
    rows = 'File_Name,caption\nclips/a.mp4,"Lift the cup, then wait"\nclips/b.mp4,Pour\n'
    (folder / "set/list.csv").write_text(rows)
    return imported(TasteRob(source=folder / "set"), folder)


@clean("trumans")
def trumans(folder):
    with pytest.raises(InputError) as refused:
        list(Trumans(source=folder).find())
    yield "refused for SMPL-X", "SMPL-X" in str(refused.value)
