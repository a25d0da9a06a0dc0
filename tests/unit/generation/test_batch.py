"""Batch generation, by networks without layers that show the hands."""

from dataclasses import replace

import pytest

from egosim_jax.data.windows import read_results
from egosim_jax.generation.batch import BatchJob
from egosim_jax.generation.generator import Generator, NonFiniteError
from egosim_jax.io.video import read_video
from egosim_jax.testing import random_triplet
from tests import shown


@pytest.fixture(autouse=True)
def generated_clips_show_the_hands(monkeypatch):
    shown.show_hands(monkeypatch)


def windows(folder, **grays):
    return shown.windows_of_hands(folder, grays, target=random_triplet(shown.MODEL.video).prior)


def job(out, **changes):
    return BatchJob(model=shown.MODEL, out=out, weights=None, **changes)


def brightness(path):
    return float(read_video(path).frames[-1].mean())


def run(given, found):
    given.open()
    outcome = given.generate(found)
    return outcome, {k: line["status"] for k, line in (read_results(given.out) or {}).items()}


def test_an_old_clip_whose_inputs_broke_and_were_repaired_differently_is_made_again(tmp_path):
    out, found = tmp_path / "out", windows(tmp_path / "clips", a=40, b=120)
    assert run(job(out), found)[1] == {"a": "done", "b": "done"}
    found[0].files.hands.unlink()
    assert run(job(out), found)[1] == {"a": "failed", "b": "done"}
    found = windows(tmp_path / "clips", a=200, b=120)
    outcome, statuses = run(job(out, skip_existing=True), found)
    assert (outcome.existing, outcome.done, statuses["a"]) == (1, 1, "done")
    assert brightness(out / "a.mp4") == pytest.approx(200, abs=4)


@pytest.mark.parametrize(
    ("policy", "truth"), [("strict", "not in the metadata"), ("lenient", "missing file")]
)
def test_a_reconstruction_without_ground_truth_is_refused_before_work(tmp_path, policy, truth):
    found = windows(tmp_path / "clips", a=40, b=120)
    if truth == "missing file":
        found[0].files.target.unlink()
    else:
        found[0] = replace(found[0], files=replace(found[0].files, target=None))
    given = job(tmp_path / "out", reconstruct=True, policy=policy)
    valid, rejected = given.check(found)
    assert [window.output_id for window in valid] == ["b"]
    assert "omit --reconstruct" in rejected[0][1]
    outcome, statuses = run(given, found)
    assert (outcome.done, outcome.rejected, statuses) == (1, 1, {"a": "failed", "b": "done"})
    assert not job(tmp_path / "other", policy="lenient").check(found)[1]


@pytest.mark.parametrize("name", ["target", "hands"])
def test_a_file_that_disappears_after_the_check_costs_one_clip(tmp_path, name):
    out, found = tmp_path / "out", windows(tmp_path / "clips", a=40, b=120)
    given = job(out, reconstruct=True, policy="lenient", batch_size=2)

    def load(mesh):
        getattr(found[0].files, name).unlink()
        return given.load(mesh)

    given.open()
    outcome = given.generate(found, load=load)
    assert (outcome.done, outcome.failed) == (1, 1)
    results = read_results(out)
    assert results["b"]["status"] == "done"
    assert ("ground truth" if name == "target" else "No such file") in results["a"]["error"]
    assert (out / "b_vae.mp4").exists()


def test_one_clip_that_is_not_finite_does_not_cost_the_others_of_its_batch(tmp_path, monkeypatch):
    made = Generator.generate

    def generate(self, triplets, seeds, **options):
        if bad := [n for n, triplet in enumerate(triplets) if triplet.video_id == "b"]:
            raise NonFiniteError([triplet.video_id for triplet in triplets], bad)
        return made(self, triplets, seeds, **options)

    monkeypatch.setattr(Generator, "generate", generate)
    out, found = tmp_path / "out", windows(tmp_path / "clips", a=40, b=120, c=200)
    outcome, statuses = run(job(out, batch_size=3), found)
    assert (outcome.done, outcome.failed) == (2, 1)
    assert statuses == {"a": "done", "b": "failed", "c": "done"}
    assert "not finite" in read_results(out)["b"]["error"]
    assert brightness(out / "c.mp4") == pytest.approx(200, abs=4)
