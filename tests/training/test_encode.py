"""Encoding to latents shards: complete, and the same after interruptions or on many processes."""

import dataclasses
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file, save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.configs.model import Networks
from egosim_jax.data import manifest
from egosim_jax.data.check import check
from egosim_jax.data.loader import Loader
from egosim_jax.data.manifest import MANIFEST, read_manifest
from egosim_jax.data.records import to_bytes
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.io.weights import hashes
from egosim_jax.io.writing import encode_video
from egosim_jax.runtime.command import ExitCode
from egosim_jax.train import encode as encoding
from egosim_jax.train.distributed import free_local_address
from egosim_jax.train.encode import check_encoders, encode_shards
from egosim_jax.train.peers import PEER_DIED
from egosim_jax.types import InputError, VideoSpec
from tests import flags

pytestmark = pytest.mark.slow
DEBUG = configs.get("debug")
CONFIG = dataclasses.replace(DEBUG, video=VideoSpec(frames=5, height=16, width=32))
FROZEN = dataclasses.replace(CONFIG, encoders="frozen")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of weights without a denoiser."""
    folder = tmp_path_factory.mktemp("weights")
    Networks.random(CONFIG, seed=0).save(folder)
    (folder / "dit.safetensors").unlink()
    return folder


def write_clips(folder: Path, spec: VideoSpec, count: int = 3, frames: int = 8) -> Path:
    """Random clips: four windows of 5 frames in each of 8."""
    rng = np.random.default_rng(0)
    video = (frames, spec.height, spec.width)
    with ShardWriter(folder, kind="frames", spec=spec) as writer:
        for number in range(count):
            arrays = {
                name: rng.integers(0, 256, (*video, 3)).astype(np.uint8)
                for name in ("target", "prior", "hands")
            }
            arrays["mask"] = np.zeros(video, np.uint8)
            arrays["first_frame"] = arrays["prior"][0]
            names = {"video_id": f"clip_{number}", "prompt": f"take cup {number}"}
            writer.add(arrays, {**names, "extra": {"split": "train"}})
    return folder


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> ShardReader:
    return ShardReader(write_clips(tmp_path_factory.mktemp("clips"), CONFIG.video))


def encode(source: ShardReader, weights: Path, out: Path, **options) -> list[int]:
    """Twelve windows in three shards of five, five and two."""
    fixed = {"stride": 1, "batch_size": 2, "shard_windows": 5}
    return encode_shards(CONFIG, weights, source=source, out=out, **{**fixed, **options})


@pytest.fixture(scope="module")
def encoded(source, weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("encoded")
    encode(source, weights, out)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    """Every file except the description of the machine."""
    return {
        path.name: path.read_bytes() for path in folder.iterdir() if path.name != "environment.json"
    }


def test_every_window_is_a_record_in_order(encoded):
    reader = ShardReader(encoded)
    windows = [(record.metadata["video_id"], record.metadata["start"]) for record in reader]
    assert windows == [(f"clip_{number}", start) for number in range(3) for start in range(4)]
    assert [shard.records for shard in reader.manifest.shards] == [5, 5, 2]
    assert reader[0].metadata["extra"] == {"split": "train"}
    assert not [problem for _, problems in check(encoded) for problem in problems]
    assert not (encoded / "parts").exists()


def test_frames_are_not_decoded_again(source, weights, tmp_path):
    with pytest.raises(InputError, match=r"decoded as 'accurate', not official\. Pack"):
        encode(source, weights, tmp_path / "out", decoding="official")
    assert not (tmp_path / "out").exists()


def test_the_manifest_names_what_made_the_arrays_alone(encoded, source, weights):
    assert read_manifest(encoded).provenance == {
        "config": "debug",
        "source": source.manifest.fingerprint,
        "encoders": {"vae": hashes(weights)["vae"]},
        "decoding": "accurate",
        "mask": {"packing": "space", "channels": 4},
    }


def test_latents_of_joint_encoders_come_with_their_inputs(encoded):
    arrays = ShardReader(encoded)[0].arrays
    assert {name: array.shape for name, array in arrays.items()} == {
        "target": (2, 2, 4, 16),
        "prior": (2, 2, 4, 16),
        "hands": (2, 2, 4, 16),
        "mask": (2, 2, 4, 4),
        "ids": (128,),
        "ids_mask": (128,),
        "pixels": (28, 28, 3),
    }


def test_latents_of_frozen_encoders_come_with_their_embeddings(source, weights, tmp_path):
    encode_shards(FROZEN, weights, source=source, out=tmp_path, stride=4, batch_size=3)
    arrays = ShardReader(tmp_path)[0].arrays
    assert (arrays["text"].shape, arrays["image"].shape) == ((128, 64), (5, 32))
    assert "ids" not in arrays
    assert read_manifest(tmp_path).provenance["encoders"] == hashes(weights)


def test_an_interrupted_run_goes_on_and_gives_the_same_bytes(
    encoded, source, weights, tmp_path, monkeypatch
):
    """The first time it ends within the second part."""
    whole, calls = encoding.Encoding.__call__, []

    def failing(self, triplets):
        calls.append(triplets)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return whole(self, triplets)

    monkeypatch.setattr(encoding.Encoding, "__call__", failing)
    with pytest.raises(KeyboardInterrupt):
        encode(source, weights, tmp_path)
    assert not (tmp_path / MANIFEST).exists()
    assert [path.name for path in (tmp_path / "parts").glob(f"*/{MANIFEST}")] == [MANIFEST]
    done = len(calls)
    encode(source, weights, tmp_path)
    assert len(calls) == done + 3 + 1  # five windows and two, by twos
    assert contents(tmp_path) == contents(encoded)


def test_a_run_killed_while_the_shards_are_put_together_goes_on(
    encoded, source, weights, tmp_path, monkeypatch
):
    def killed(path, value):
        if path.parent == tmp_path and path.name == MANIFEST:
            raise KeyboardInterrupt
        before(path, value)

    before = manifest.write_json
    monkeypatch.setattr(manifest, "write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        encode(source, weights, tmp_path)
    monkeypatch.undo()
    encode(source, weights, tmp_path)
    assert contents(tmp_path) == contents(encoded)


def test_processes_share_the_parts_and_give_the_same_bytes(encoded, source, weights, tmp_path):
    with pytest.raises(InputError, match=r"1 of 3 parts are missing in .*: 00001"):
        encode(source, weights, tmp_path, process_index=0, process_count=2)
    encode(source, weights, tmp_path, process_index=1, process_count=2)
    assert not (tmp_path / MANIFEST).exists()
    encode(source, weights, tmp_path, process_index=0, process_count=2)
    assert contents(tmp_path) == contents(encoded)


def test_a_finished_folder_is_left_alone(encoded, source, weights, monkeypatch):
    monkeypatch.setattr(encoding, "Encoding", lambda *_: pytest.fail("it encodes"))
    before = (encoded / MANIFEST).stat().st_mtime_ns
    encode(source, weights, encoded)
    assert (encoded / MANIFEST).stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("options", "message"),
    [({"stride": 2}, "stride: the folder has 1"), ({"shard_windows": 6}, "shard_windows: the")],
)
def test_a_folder_of_other_settings_is_refused(encoded, source, weights, options, message):
    with pytest.raises(InputError, match=message):
        encode(source, weights, encoded, **options)


@pytest.fixture(scope="module")
def others(weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of another autoencoder."""
    folder = tmp_path_factory.mktemp("others")
    tensors = load_file(weights / "vae.safetensors")
    save_file({name: 2 * tensor for name, tensor in tensors.items()}, folder / "vae.safetensors")
    return folder


def test_a_folder_of_other_encoders_or_clips_is_refused(encoded, source, weights, others, tmp_path):
    with pytest.raises(InputError, match=r"encoders\.vae: the folder has"):
        encode(source, others, encoded)
    clips = ShardReader(write_clips(tmp_path, CONFIG.video, count=2))
    with pytest.raises(InputError, match="source: the folder has"):
        encode(clips, weights, encoded)


def test_what_cannot_be_encoded_is_refused(encoded, source, weights, tmp_path):
    with pytest.raises(InputError, match="expected videos or frames with their target"):
        encode(ShardReader(encoded), weights, tmp_path / "a")
    short = ShardReader(write_clips(tmp_path / "short", CONFIG.video, frames=4))
    with pytest.raises(InputError, match="record 0 has 4 frames; a window needs 5"):
        encode(short, weights, tmp_path / "b")
    with pytest.raises(InputError, match="--batch-size must be at least 1"):
        encode(source, weights, tmp_path / "c", batch_size=0)
    with pytest.raises(InputError, match="already holds other shards"):
        encode(source, weights, tmp_path / "short")


def damage(source: ShardReader, numbers: Collection[int], folder: Path) -> ShardReader:
    """A copy of a source with a flipped byte in some records."""
    shutil.copytree(source.folder, folder)
    path = folder / source.manifest.shards[0].file
    data = bytearray(path.read_bytes())
    for number in numbers:
        data[data.index(to_bytes(source[number])[-100:])] ^= 0xFF
    path.write_bytes(data)
    return ShardReader(folder)


def test_a_damaged_clip_is_skipped_and_named(encoded, source, weights, tmp_path, caplog):
    """Its four windows are in the first part and in the second one.

    Others have other places in their batches, in float32.
    """
    bad = damage(source, [1], tmp_path / "bad")
    assert encode(bad, weights, tmp_path / "out") == [1]
    assert "bad/shard-00000.array_record, record 1" in caplog.text
    reader, whole = ShardReader(tmp_path / "out"), ShardReader(encoded)
    assert reader.manifest.provenance["skipped"] == [1]
    assert [record.metadata["video_id"] for record in reader] == ["clip_0"] * 4 + ["clip_2"] * 4
    found, expected = reader[4].arrays["target"], whole[8].arrays["target"]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    assert encode(bad, weights, tmp_path / "out") == [1]


def test_a_part_of_a_damaged_clip_alone_has_no_shard(source, weights, tmp_path):
    bad = damage(source, [1], tmp_path / "bad")
    for process in (1, 0):
        shared = {"shard_windows": 4, "process_index": process, "process_count": 2}
        assert encode(bad, weights, tmp_path / "out", **shared) == [1]
    assert [shard.records for shard in read_manifest(tmp_path / "out").shards] == [4, 4]


def test_too_many_damaged_clips_are_refused(source, weights, tmp_path, monkeypatch):
    monkeypatch.setattr(Loader, "MAX_BAD", 1)
    with pytest.raises(InputError, match=r"2 of 3 clips of .* cannot be read: at most 1"):
        encode(damage(source, [0, 2], tmp_path / "bad"), weights, tmp_path / "out")
    monkeypatch.setattr(Loader, "MAX_BAD", 3)
    with pytest.raises(InputError, match=r"3 of 3 clips of .* and not all"):
        encode(damage(source, [0, 1, 2], tmp_path / "none"), weights, tmp_path / "out2")


def test_a_part_that_lost_its_bytes_is_named(source, weights, tmp_path):
    encode(source, weights, tmp_path, process_index=1, process_count=2)
    (part,) = (tmp_path / "parts").glob("*/*.array_record")
    part.write_bytes(b"")
    with pytest.raises(InputError, match=r"0 bytes, expected .*remove .*parts/00001"):
        encode(source, weights, tmp_path, process_index=0, process_count=2)
    assert not (tmp_path / MANIFEST).exists()


def test_shards_fit_the_weights_that_encoded_them(encoded, weights, others):
    check_encoders(encoded, CONFIG, weights)
    check_encoders(encoded, CONFIG, None)
    with pytest.raises(InputError, match=r"(?s)vae: the shards have .*Encode again") as caught:
        check_encoders(encoded, CONFIG, others)
    assert hashes(others)["vae"][:16] in str(caught.value)


def test_shards_of_another_model_or_for_weights_without_a_vae_are_refused(
    encoded, weights, tmp_path
):
    with pytest.raises(InputError, match="config: the shards have debug, this training has odd"):
        check_encoders(encoded, dataclasses.replace(CONFIG, name="odd"), None)
    with pytest.raises(InputError, match=r"video: .*height=16.*height=64"):
        check_encoders(encoded, DEBUG, weights)
    with pytest.raises(InputError, match=r"vae: the shards have .* none"):
        check_encoders(encoded, CONFIG, tmp_path)


@pytest.mark.parametrize(
    ("provenance", "message"),
    [
        ({}, "without the hashes of their encoders"),
        (
            {"config": "debug", "encoders": {"vae": "1" * 64}},
            r"mask: the shards have no record of it.*Encode again",
        ),
    ],
)
def test_shards_without_a_record_of_encoders_or_mask_are_refused(tmp_path, provenance, message):
    spec = CONFIG.video
    with ShardWriter(tmp_path, kind="latents", spec=spec, provenance=provenance) as writer:
        writer.add({"target": np.zeros((2, 2, 4, 16), np.float32)}, {"video_id": "a"})
    with pytest.raises(InputError, match=message):
        check_encoders(tmp_path, CONFIG, None)


def start(weights: Path, clips: Path, out: Path, count: int) -> list[subprocess.Popen]:
    """Start the processes of an encoding by the command."""
    shared = {"JAX_COORDINATOR_ADDRESS": free_local_address(), "JAX_NUM_PROCESSES": str(count)}
    return [
        subprocess.Popen(
            [sys.executable, "-m", "egosim_jax.cli", *command(weights, clips, out)],
            env=os.environ
            | flags.devices(1)
            | ({**shared, "JAX_PROCESS_ID": str(index)} if count > 1 else {}),
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(count)
    ]


def command(weights: Path, clips: Path, out: Path) -> list[str]:
    options = {"config": "debug", "weights": weights, "shards": clips, "out": out}
    given = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    return ["data", "encode", *given, "--shard-windows", "2"]


def test_one_of_two_processes_is_killed_and_one_process_goes_on(weights, tmp_path):
    """Killed when its first part of several exists, while both still encode."""
    clips = write_clips(tmp_path / "clips", DEBUG.video, count=24, frames=13)
    out = tmp_path / "killed"
    other, victim = start(weights, clips, out, 2)
    while victim.poll() is None and not (out / "parts" / "00001" / MANIFEST).exists():
        time.sleep(0.01)
    victim.kill()
    said = other.communicate(timeout=60)[1]
    victim.communicate(timeout=60)
    assert other.returncode == ExitCode.RESUBMIT, said
    assert said.rstrip().endswith(PEER_DIED)
    assert not (out / MANIFEST).exists()
    assert main(command(weights, clips, out)) == 0
    assert main(command(weights, clips, tmp_path / "whole")) == 0
    assert read_manifest(out) == read_manifest(tmp_path / "whole")
    assert json.loads((out / "config.json").read_text("utf-8"))["config"] == "debug"


@pytest.mark.parametrize("count", [1, 2])
def test_sigterm_ends_an_encoding_with_75_and_it_goes_on(weights, tmp_path, count):
    clips = write_clips(tmp_path / "clips", DEBUG.video, count=24, frames=13)
    out = tmp_path / "out"
    processes = start(weights, clips, out, count)
    while processes[-1].poll() is None and not list(out.glob(f"parts/*{count - 1}/{MANIFEST}")):
        time.sleep(0.01)
    for process in processes:
        process.send_signal(signal.SIGTERM)
    said = [process.communicate(timeout=120)[1] for process in processes]
    assert {process.returncode for process in processes} == {ExitCode.RESUBMIT}, said
    assert not (out / MANIFEST).exists()
    assert list(out.glob(f"parts/*/{MANIFEST}"))
    assert main(command(weights, clips, out)) == 0
    assert len(ShardReader(out)) == 24


def test_the_decoding_of_videos_is_recorded(weights, tmp_path):
    clip = np.random.default_rng(0).integers(0, 256, (5, 16, 32, 3)).astype(np.uint8)
    videos = {
        name: np.frombuffer(encode_video(clip, 16), np.uint8)
        for name in ("target", "prior", "hands", "mask")
    }
    png = io.BytesIO()
    Image.fromarray(clip[0]).save(png, "PNG")
    videos["first_frame"] = np.frombuffer(png.getvalue(), np.uint8)
    with ShardWriter(tmp_path / "videos", kind="videos") as writer:
        writer.add(videos, {"video_id": "a", "prompt": "take it"})
    targets = {}
    for decoding in ("accurate", "official"):
        out = tmp_path / decoding
        encode(ShardReader(tmp_path / "videos"), weights, out, decoding=decoding, batch_size=1)
        assert read_manifest(out).provenance["decoding"] == decoding
        targets[decoding] = ShardReader(out)[0].arrays["target"]
    assert (targets["accurate"] != targets["official"]).any()
