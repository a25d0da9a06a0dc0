"""`egosim data annotate` and `egosim episode from-annotation`."""

import pytest

from egosim_jax.annotate.config import AnnotateConfig
from egosim_jax.cli.__main__ import main
from egosim_jax.runtime.command import ExitCode
from egosim_jax.simulation.episode import Episode
from tests.unit.annotate.stubs import config, textured_video, write

OPTIONS = ["--renderer", "numpy", "--caption", "take the cup"]


@pytest.fixture
def video(tmp_path, monkeypatch):
    monkeypatch.setattr(AnnotateConfig, "build", lambda self: config().build())
    return write(tmp_path / "cup.mp4", textured_video(33, 96, 160))


def test_a_video_is_annotated_packed_and_made_an_episode(video, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["data", "annotate", str(video), "--out", str(out), *OPTIONS]) == ExitCode.DONE
    assert capsys.readouterr().out == f"{out}\n"
    shards = str(tmp_path / "shards")
    packed = ["data", "pack", "--metadata", str(out / "metadata.csv"), "--out", shards]
    assert main(packed) == ExitCode.DONE
    assert main(["data", "check", "--shards", shards]) == ExitCode.DONE
    made = ["episode", "from-annotation", str(out / "cup"), "--out", str(tmp_path / "episode")]
    made += ["--config", "real_tiny"]
    assert main(made) == ExitCode.DONE
    episode = Episode.load(tmp_path / "episode")
    assert (episode.shape, len(episode.actions)) == ((17, 96, 160), 2)
    # The same command gives the same episode; another one is not replaced.
    assert main(made) == ExitCode.DONE
    before = (tmp_path / "episode" / "episode.json").read_bytes()
    capsys.readouterr()
    assert main([*made, "--clips", "1"]) == ExitCode.USAGE
    assert "another episode of 2 clips, not 1 clip" in capsys.readouterr().err
    assert (tmp_path / "episode" / "episode.json").read_bytes() == before


def test_a_video_without_clips_is_named_with_its_reason(video, tmp_path, capsys):
    (tmp_path / "bad.mp4").touch()
    command = ["data", "annotate", str(video), str(tmp_path / "bad.mp4"), "--out"]
    assert main([*command, str(tmp_path / "out"), *OPTIONS]) == ExitCode.PARTIAL
    shown = capsys.readouterr().err
    assert "bad: no clip: " in shown
    assert "is empty" in shown
    assert "1 clip done, 0 refused, 0 failed; of 2 videos, 1 without a clip" in shown


def test_a_models_clips_have_its_size_rate_and_length(video, tmp_path):
    out = tmp_path / "out"
    command = ["data", "annotate", str(video), "--out", str(out), "--config", "real_tiny"]
    assert main([*command, "--clips", *OPTIONS]) == ExitCode.DONE
    assert (out / "cup_0_16/video.mp4").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--clips"], "--clips needs the length"),
        (["--depth", "magic"], "--depth 'magic' must be one of sweep, depth-anything=FOLDER"),
        (["--masks", "grounded-sam3=."], "belong together"),
        (["--scale", "2", "--camera-height", "1"], "choose one"),
        (["--focal", "-3"], "--focal is -3"),
        (["--workers", "0"], "--workers must be at least 1"),
    ],
)
def test_wrong_options_are_refused_before_any_work(video, tmp_path, capsys, options, message):
    out = tmp_path / "out"
    code = main(["data", "annotate", str(video), "--out", str(out), *options])
    assert code == ExitCode.USAGE
    assert message in capsys.readouterr().err
    assert not (out / "work").exists()
