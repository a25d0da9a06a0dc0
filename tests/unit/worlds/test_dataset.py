"""Datasets of the tabletop world: complete, ordered and independent of interruptions."""

from dataclasses import dataclass

import pytest

from egosim_jax.data.shards import ShardReader
from egosim_jax.types import InputError, VideoGrid, VideoSpec
from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards

SPEC = VideoSpec(frames=5, height=32, width=48)
CONFIG = DatasetConfig(seeds=(3, 4), clips=2, spec=SPEC, kind="human")
ROBOT = DatasetConfig(seeds=(5,), clips=1, spec=SPEC, kind="robot")
GRID = VideoGrid(temporal_stride=2, spatial_stride=4, patch=2)


@pytest.mark.slow
def test_an_interrupted_run_resumes_and_gives_the_same_shards(tmp_path):
    complete, broken = tmp_path / "complete", tmp_path / "broken"
    assert sorted(make_shards(CONFIG, out=complete, workers=2)) == [3, 4]
    progress = make_shards(CONFIG, out=broken, workers=1)
    next(progress)
    progress.close()
    assert not (broken / "manifest.json").exists()
    assert sorted(make_shards(CONFIG, out=broken, workers=1)) == [3, 4]
    first, second = ShardReader(complete), ShardReader(broken)
    assert first.manifest.fingerprint == second.manifest.fingerprint
    names = [record.metadata["video_id"] for record in first]
    assert names == [f"tabletop_human_{seed}_{number}" for seed in (3, 4) for number in (0, 1)]
    assert not (broken / "parts").exists()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    list(make_shards(ROBOT, out=folder, workers=1))
    return folder


def test_a_finished_folder_is_not_written_again(finished):
    before = (finished / "manifest.json").stat().st_mtime_ns
    assert list(make_shards(ROBOT, out=finished, workers=1)) == [5]
    assert (finished / "manifest.json").stat().st_mtime_ns == before


@dataclass(frozen=True)
class OwnStates:
    """Every clip starts from its own state."""

    version: int = 1

    def __call__(self, clips):
        return [None for _ in clips]


@pytest.mark.slow
def test_priors_are_rendered_from_the_states_that_are_asked_for(tmp_path):
    own, true = tmp_path / "own", tmp_path / "true"
    config = DatasetConfig(seeds=(5,), clips=2, spec=SPEC, kind="human")
    list(make_shards(config, out=own, workers=1, states=OwnStates()))
    list(make_shards(config, out=true, workers=1))
    (same, differing) = zip(ShardReader(own), ShardReader(true), strict=True)
    assert (same[0].arrays["prior"] == same[1].arrays["prior"]).all()
    assert (differing[0].arrays["first_frame"] != differing[1].arrays["first_frame"]).any()
    with pytest.raises(InputError, match="version"):
        list(make_shards(config, out=own, workers=1, states=OwnStates(2)))


def test_every_fourth_mixed_scene_has_a_robot():
    config = DatasetConfig(seeds=(7, 8, 9), clips=1, spec=SPEC, kind="mixed")
    kinds = [next(config.clips_of(seed)).kind for seed in config.seeds]
    assert kinds == ["human", "robot", "human"]


@pytest.mark.parametrize(("seeds", "message"), [((), "--scenes"), ((-1, 0), "--seed must be")])
def test_a_dataset_that_is_empty_or_of_a_negative_seed_is_refused(seeds, message):
    with pytest.raises(InputError, match=message):
        DatasetConfig(seeds=seeds, clips=1, spec=SPEC, kind="human")


def test_the_manifest_has_the_grid_that_the_clips_fit(tmp_path):
    spec = VideoSpec(frames=3, height=24, width=40)
    config = DatasetConfig(seeds=(5,), clips=1, spec=spec, kind="robot")
    with pytest.raises(InputError, match="3 frames cannot be encoded"):
        list(make_shards(config, out=tmp_path, workers=1))
    list(make_shards(config, out=tmp_path, workers=1, grid=GRID))
    assert ShardReader(tmp_path).manifest.grid == GRID


def test_a_finished_dataset_of_another_grid_is_refused(finished):
    with pytest.raises(InputError, match="another latent grid"):
        list(make_shards(ROBOT, out=finished, workers=1, grid=GRID))
