"""MediaPipe's networks on the CPU: a file is run picture by picture, or refused."""

import sys

import numpy as np
import pytest

from egosim_jax.perception.hands import LandmarkHands
from egosim_jax.perception.hands.litert import LiteRtNetworks
from egosim_jax.perception.hands.weights import LANDMARKS, MEDIAPIPE, PALMS
from egosim_jax.types import InputError

pytest.importorskip("ai_edge_litert")

from tests.tflite import Writer


def write_palms(path):
    """A detector of 1 x 1 pixels that repeats them for each anchor."""
    writer = Writer()
    x = writer.tensor((1, 192, 192, 3))
    pooled = writer.add(
        "MAX_POOL_2D",
        [x],
        (1, 24, 24, 3),
        "Pool2DOptions",
        padding=1,
        strideW=8,
        strideH=8,
        filterWidth=8,
        filterHeight=8,
    )
    flat = writer.add(
        "RESHAPE", [pooled, writer.constant(np.array([1, 1728, 1], np.int32))], (1, 1728, 1)
    )
    paddings = np.array([[0, 0], [0, 288], [0, 0]], np.int32)
    logits = writer.add("PAD", [flat, writer.constant(paddings)], (1, 2016, 1), "PadOptions")
    wide = np.array([[0, 0], [0, 0], [0, 17]], np.int32)
    boxes = writer.add("PAD", [logits, writer.constant(wide)], (1, 2016, 18), "PadOptions")
    writer.write(path, [x], [boxes, logits])


def test_pictures_are_scaled_to_one_and_run_one_by_one(tmp_path):
    write_palms(tmp_path / "palms.tflite")
    networks = LiteRtNetworks(tmp_path / "palms.tflite", tmp_path / "palms.tflite", threads=1)
    pictures = np.zeros((2, 192, 192, 3), np.uint8)
    pictures[1, :8, :8] = [51, 102, 255]
    boxes, logits = networks.palms(pictures)
    assert boxes.shape == (2, 2016, 18)
    np.testing.assert_allclose(logits[0], 0)
    np.testing.assert_allclose(logits[1, :4], [0.2, 0.4, 1, 0], atol=1e-6)


def test_a_file_that_is_no_network_is_refused(tmp_path):
    (tmp_path / "palms.tflite").write_bytes(b"no network")
    with pytest.raises(InputError, match="not a model that LiteRT can run"):
        LiteRtNetworks(tmp_path / "palms.tflite", tmp_path / "palms.tflite", threads=1)


def test_without_litert_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(InputError, match=r"egosim-jax\[video\]"):
        LiteRtNetworks(tmp_path / "palms.tflite", tmp_path / "palms.tflite", threads=1)


def test_given_weights_are_verified_before_they_are_run(tmp_path):
    for name in (PALMS, LANDMARKS):
        (tmp_path / name).write_bytes(b"other weights")
    with pytest.raises(InputError, match=r"palm_detection_full\.tflite has SHA-256"):
        LandmarkHands(weights=tmp_path)(np.zeros((1, 48, 64, 3), np.uint8))


def test_offline_without_weights_is_refused_with_the_way_out(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(InputError, match="egosim models fetch hands"):
        LandmarkHands(offline=True)(np.zeros((1, 48, 64, 3), np.uint8))


def test_the_networks_and_their_license_are_pinned():
    assert MEDIAPIPE.requirement == "mediapipe==0.10.14"
    assert {path.rsplit("/", 1)[-1] for path in MEDIAPIPE.files} == {PALMS, LANDMARKS, "LICENSE"}
    assert all(len(digest) == 64 for digest in MEDIAPIPE.files.values())
