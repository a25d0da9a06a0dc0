"""Annotation on Ray."""

import json
import os
from importlib.util import find_spec

import pytest

from egosim_jax.annotate import run
from egosim_jax.annotate.clip import annotate as annotate_clip
from egosim_jax.annotate.cluster import annotate_on_ray
from egosim_jax.annotate.sources import find_sources
from tests.system.test_sockets import LOOPBACK, listening
from tests.unit.annotate.stubs import config, textured_video, write
from tests.unit.annotate.test_run import annotate


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="the extra cluster is not installed")
@pytest.mark.filterwarnings("ignore")
def test_ray_makes_the_same_annotations_as_a_local_run(tmp_path):
    videos = [
        write(tmp_path / f"v{k}.mp4", textured_video(9, seed=k, shift=0.0 if k == 1 else 1.0))
        for k in range(3)
    ]
    out, settings = tmp_path / "ray", config()
    run.require_config(out, settings)
    scanned = list(run.scan_sources(find_sources(videos), out, settings, workers=1))
    jobs = run.choose_jobs(scanned, out, settings)
    assert len(jobs) == 2  # one does not move
    assert annotate_clip(jobs[0], out, settings, settings.build()) == "done"  # before, without Ray
    statuses, addresses = [], set()
    for status in annotate_on_ray(jobs, out, settings, address="auto"):
        statuses.append(status)
        addresses |= listening(os.getpid())
    assert statuses == ["done"] * 2
    assert addresses <= LOOPBACK
    reports = [run.write_report(scanned, out), annotate(videos, tmp_path / "local")]
    for report in reports:
        for about in report["annotations"]:
            about.pop("seconds", None)
    assert json.dumps(reports[0]) == json.dumps(reports[1])
    for name in ("metadata.csv", "v2/ego_prior_video.mp4", "v2/action.npz"):
        assert (out / name).read_bytes() == (tmp_path / "local" / name).read_bytes()
