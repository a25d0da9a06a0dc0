"""Training and validation clips of metadata with and without a split."""

import json
import os
import subprocess
import sys

import pytest

from egosim_jax.data.metadata import read_metadata
from egosim_jax.runtime.command import ExitCode
from egosim_jax.train.from_scratch import select_split
from egosim_jax.types import InputError
from tests import flags
from tests.system.test_secrets import SECRETS, reveals_nothing
from tests.system.test_sockets import LOOPBACK

STAGES = ("vae", "denoiser")


def train(*options, devices):
    """The finished program, in an environment with secrets."""
    return subprocess.run(
        [sys.executable, "-m", "egosim_jax.train", *map(str, options)],
        env=os.environ | SECRETS | flags.devices(devices),
        capture_output=True,
        text=True,
        timeout=900,
    )


def test_a_batch_that_the_devices_cannot_share_is_refused_before_the_data(tmp_path):
    refused = train("real_tiny", "--metadata", "none.csv", "--out", tmp_path / "run", devices=3)
    assert refused.returncode == ExitCode.USAGE
    assert "A batch of 2 cannot be shared" in refused.stderr
    assert "--vae.batch-size" in refused.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_debug_trains_on_three_devices_and_keeps_its_options_from_the_first_update(tmp_path):
    out = tmp_path / "run"
    fixed = ["debug", "--clips", "4", "--clip-frames", "9", "--denoiser.steps", "1"]
    # Crops that no frame has: the data are made, and no update.
    crop = ("--vae.steps", 2, "--crop", 4096, 4096)
    failed = train(*fixed, "--out", out, *crop, devices=3)
    assert failed.returncode == ExitCode.USAGE, failed.stderr
    done = ["egosim_jax.train", *fixed, "--vae.steps", "1"]
    assert reveals_nothing(done, out, **flags.devices(3)) <= LOOPBACK
    configs = [json.loads((out / stage / "config.json").read_text()) for stage in STAGES]
    assert [config["training"]["batch_size"] for config in configs] == [3, 3]
    changed = train(*fixed, "--out", out, "--vae.steps", 2, devices=3)
    assert changed.returncode == ExitCode.USAGE
    assert "vae.steps" in changed.stderr


@pytest.fixture
def read(tmp_path):
    """Write metadata of clips with these splits, None without the column; return its rows."""

    def write(*splits):
        lines = ["video_id,ego_prior_video,prompt,split"]
        lines += [f"clip{n},prior.mp4,a hand,{split}" for n, split in enumerate(splits)]
        if None in splits:
            lines = [line.rsplit(",", 1)[0] for line in lines]
        (tmp_path / "metadata.csv").write_text("\n".join(lines))
        return read_metadata(tmp_path / "metadata.csv")

    return write


@pytest.mark.parametrize(
    ("splits", "held_out"),
    [
        (["test", "train", "train", "test"], [0, 3]),
        (["train"] * 17, [7, 15]),
        ([None] * 17, [7, 15]),
        (["train"] * 3, [2]),
    ],
)
def test_clips_are_held_out_by_their_split_or_every_eighth_or_the_last(
    read, splits, held_out, capsys
):
    items = read(*splits)
    train, test = (
        [int(item.video_id.removeprefix("clip")) for item in select_split(items, split)]
        for split in ("train", "test")
    )
    assert test == held_out
    assert sorted(train + test) == list(range(len(splits)))
    assert ("are held out" in capsys.readouterr().out) == ("test" not in splits)


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        (["train"], "one clip: validation needs another"),
        (["train", "val"], "No clip has split=test; split is one of: train, val"),
    ],
)
def test_clips_without_a_split_to_validate_on_are_refused(read, splits, message):
    with pytest.raises(InputError, match=message):
        select_split(read(*splits), "test")
