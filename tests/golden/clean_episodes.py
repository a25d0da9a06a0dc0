"""Clean sources of episodes: a LeRobot dataset with hands, and files of a user."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from egosim_jax.annotate.lerobot_episode import episode_from_lerobot
from egosim_jax.cli.episode import MakeEpisode
from egosim_jax.data.lerobot_writer import HANDS, INTRINSICS, POSES
from egosim_jax.simulation.episode import Episode
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import VideoSpec
from tests.captures import World
from tests.golden import fingerprints as fp
from tests.golden.clean_recordings import lerobot_rows
from tests.golden.fingerprints import clean
from tests.unit.data.readers import test_lerobot as lerobot_files


def scene(world):
    """State of a plane at 0.6 m before the first camera."""
    shape = (world.height, world.width)
    image = world.video[0]
    return state_from_depth(image, np.full(shape, 0.6), world.intrinsics, world.poses[0])


@clean("from-lerobot")
def from_lerobot(folder):
    world = World(frames=17)
    features = {
        HANDS: {"dtype": "float64", "shape": [126]},
        POSES: {"dtype": "float64", "shape": [16]},
        INTRINSICS: {"dtype": "float64", "shape": [9]},
        "observation.images.head": {"dtype": "video", "shape": [96, 128, 3]},
    }
    lerobot_files.write_v3(folder, world, fps=16, features=features)
    columns = {
        HANDS: world.joints.reshape(17, -1).tolist(),
        POSES: world.poses.reshape(17, -1).tolist(),
        INTRINSICS: [world.intrinsics.ravel().tolist()] * 17,
    }
    rows = lerobot_rows([17], 16, **columns)
    pq.write_table(rows, folder / "data/chunk-000/file-000.parquet")
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    about = pq.read_table(path).slice(0, 1).to_pydict()
    pq.write_table(pa.table({**about, "length": [17]}), path)
    for fps, size in ((8, (96, 128)), (16, (48, 64))):
        spec = VideoSpec(frames=5, height=size[0], width=size[1], fps=fps)
        found = episode_from_lerobot(folder, 0, spec, state=scene(world))
        yield from fp.under(f"{fps} fps", fp.episode(found))


@clean("episode make")
def episode_make(folder):
    """Two action files, and an image and its depth that are larger than the clips."""
    world = World(frames=33, height=96, width=160)
    first, second = slice(0, 17), slice(16, 33)
    written = {
        "world_from_camera": world.poses[first].tolist(),
        "intrinsics_px": world.intrinsics.tolist(),
        "joints_m": world.joints[first].tolist(),
        "prompt": "Nimm die Schüssel.",
    }
    (folder / "1.json").write_text(json.dumps(written), "utf-8")
    arrays = {"world_from_camera": world.poses[second], "joints_m": world.joints[second]}
    np.savez(folder / "2.npz", **arrays, intrinsics_px=world.intrinsics)
    image = world.video[0].repeat(2, 0).repeat(2, 1)
    Image.fromarray(image).save(folder / "image.png")
    depth = np.full((192, 320), 0.6, np.float32)
    depth[:10] = np.nan
    np.savez(folder / "depth.npz", depth_m=depth)
    paths = {"image": folder / "image.png", "depth": folder / "depth.npz", "out": folder / "made"}
    actions, prompts = (folder / "1.json", folder / "2.npz"), ("Take the bowl.", "Put it down.")
    assert MakeEpisode(actions=actions, prompts=prompts, **paths).run() == 0
    yield from fp.episode(Episode.load(folder / "made"))
    paths["out"] = folder / "made.zip"
    assert MakeEpisode(actions=actions[:1], **paths).run() == 0
    yield from fp.under("zip", fp.episode(Episode.load(folder / "made.zip")))
