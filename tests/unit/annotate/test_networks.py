"""Networks as estimators of an annotation."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.annotate.prepare import Cutting, Quality
from egosim_jax.perception.networks.worker import close_workers
from egosim_jax.state import snapshot
from tests.unit.annotate.stubs import StubCameras, StubHands, textured_video, write
from tests.unit.annotate.test_run import annotate
from tests.unit.perception.networks import tiny


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(AnnotateConfig):
    """The chosen networks; hands and cameras from stubs."""

    def build(self) -> Estimators:
        """Return the estimators."""
        stubs = {"hands": StubHands(1.0, None), "cameras": StubCameras(False, None)}
        return replace(super().build(), **stubs)


@pytest.mark.slow
def test_depth_and_masks_of_networks_make_a_clip(tmp_path):
    torch.manual_seed(0)
    path = write(tmp_path / "cup.mp4", textured_video(9, 64, 96))
    settings = NetworkConfig(
        depth=f"depth-anything={tiny.depth_anything(tmp_path / 'depth')}",
        masks=f"grounded-edgetam={tiny.edgetam(tmp_path / 'edgetam')}",
        detector=tiny.grounding_dino(tmp_path / "dino"),
        phrases=("cup",),
        renderer="numpy",
        cutting=Cutting(quality=Quality(min_prior_gain_db=-math.inf)),  # their depth is random
    )
    settings.build().prepare()
    try:
        report = annotate([path], tmp_path / "out", settings)
    finally:
        close_workers()
    (about,) = report["annotations"]
    assert about["status"] == "done", about
    assert about["silhouettes"]["phrases"] == ["cup", "hand", "arm"]
    assert about["depth"]["source"].startswith("depth-anything=")
    assert about["scale"]["source"] == "metric depth"
    assert len(snapshot.load(tmp_path / "out/cup/state").points_m) > 0
