"""VideoMAE in its worker gives the features of transformers; a table has their FVD."""

import json

import numpy as np
import pytest
import torch

from egosim_jax.cli.table import TableCommand
from egosim_jax.evaluation.fvd import frechet_distance
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.perception.networks import VideoMae, close_workers
from tests.unit.perception.networks import tiny

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    yield tiny.video_mae(tmp_path_factory.mktemp("video_mae"))
    close_workers()


def test_features_are_those_of_transformers(folder):
    import transformers as hf

    frames = np.random.default_rng(0).integers(0, 256, (7, 32, 32, 3)).astype(np.uint8)
    network = hf.VideoMAEForVideoClassification.from_pretrained(folder).videomae
    images = torch.from_numpy(frames[[0, 2, 4, 6]]).movedim(-1, 1).float() / 255
    mean, std = (torch.tensor(x)[:, None, None] for x in ([0.5, 0.4, 0.3], [0.2, 0.3, 0.25]))
    with torch.inference_mode():
        want = network.eval()(((images - mean) / std)[None]).last_hidden_state[0].mean(dim=0)
    np.testing.assert_allclose(VideoMae(folder)(frames), want.numpy(), rtol=1e-4, atol=1e-5)


def test_a_table_has_the_distance_of_its_groups(folder, make_clips, tmp_path):
    metadata = make_clips(3)
    header, *lines = metadata.read_text().splitlines()
    metadata.write_text("\n".join([f"{header},dataset", *(f"{x},egodex" for x in lines)]) + "\n")
    network, features = VideoMae(folder), {"video": [], "target": []}
    for number in range(3):
        target = read_video(tmp_path / f"clip{number}" / "video.mp4").frames
        write_video(tmp_path / "dark" / f"clip{number}.mp4", target // 3, 16)
        video = read_video(tmp_path / "dark" / f"clip{number}.mp4").frames
        features["video"].append(network(video[1:]))
        features["target"].append(network(target[1:]))
    command = TableCommand(
        name="egosim",
        generated=(str(tmp_path / "dark"),),
        baselines=(),
        metadata=metadata,
        fvd=folder,
        lpips=(),
        out=tmp_path / "out",
        page_clips=0,
    )
    command.run()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    expected = frechet_distance(*(np.stack(vectors) for vectors in features.values()))
    assert report["splits"]["egodex"]["dark"]["fvd"]["mean"] == pytest.approx(expected, rel=1e-4)
    assert "fvd_video" not in (tmp_path / "out" / "metrics.jsonl").read_text()
