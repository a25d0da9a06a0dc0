"""The pipeline `networks` by name, with tiny random checkpoints in all of its workers."""

import shlex

import numpy as np
import pytest
import torch  # noqa: F401

from egosim_jax.io.digest import fingerprint
from egosim_jax.perception import registry
from egosim_jax.perception.networks.worker import close_workers
from egosim_jax.types import VideoSpec
from tests.unit.perception.networks import tiny

pytestmark = pytest.mark.slow
SPEC = VideoSpec(frames=5, height=48, width=64, fps=8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    names = ("depth_anything", "grounding_dino", "sam2")
    yield {name: getattr(tiny, name)(tmp_path_factory.mktemp(name)) for name in names}
    close_workers()


def text(folders, *options):
    required = ["--depth", "depth-anything", "--depth-folder", str(folders["depth_anything"])]
    required += ["--masks", "grounded-sam2", "--masks-folder", str(folders["sam2"])]
    return shlex.join(["networks", *required, *options])


def test_a_clip_of_the_world_is_perceived(folders):
    from egosim_jax.worlds.tabletop import make_sequence, to_episode

    episode = to_episode(list(make_sequence(0, spec=SPEC, clips=1, kind="human")), fps=8)
    from egosim_jax.types import Clip

    detector = ["--detector-folder", str(folders["grounding_dino"])]
    config = registry.parse(text(folders, *detector, "--threshold", "0", "--every", "4"))
    perceive = config.build()
    found = perceive(
        Clip(frames=episode.ground_truth[0].frames, fps=8), episode.actions[0], episode.state
    )
    assert found.depth_m.shape == found.object_ids.shape == (5, 48, 64)
    assert np.isfinite(found.depth_m).any() or np.isinf(found.depth_m).all()
    assert (found.object_ids < 0).any()
    assert fingerprint(perceive) == fingerprint(
        registry.parse(
            text(folders, *detector, "--threshold", "0", "--every", "4", "--timeout-s", "9")
        ).build()
    )
    assert fingerprint(perceive) != fingerprint(registry.parse(text(folders, *detector)).build())


@pytest.mark.parametrize(
    ("options", "message"),
    [((), "--detector-folder"), (("--hand-phrases", "glove"), "must each name a hand")],
)
def test_what_cannot_segment_is_refused(folders, capsys, options, message):
    with pytest.raises(SystemExit, match="2"):
        registry.parse(text(folders, *options))
    assert message in " ".join(capsys.readouterr().err.split())
