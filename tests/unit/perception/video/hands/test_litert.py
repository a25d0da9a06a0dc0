"""MediaPipe's networks on the CPU: runs of single images, and refused files."""

import sys

import numpy as np
import pytest

from egosim_jax.annotate.config import AnnotateConfig
from egosim_jax.perception.video.hands import LandmarkHands
from egosim_jax.perception.video.hands.litert import LANDMARKS, PALMS, HandNetworks
from egosim_jax.types import InputError

pytest.importorskip("ai_edge_litert")

import flatbuffers
from ai_edge_litert import schema_py_generated as schema

BLACK = np.zeros((1, 48, 64, 3), np.uint8)


class Writer:
    """Builder of a TensorFlow Lite file: tensors by number, operations in order."""

    def __init__(self):
        self.model, self.graph = schema.ModelT(), schema.SubGraphT()
        self.model.version, self.model.subgraphs = 3, [self.graph]
        self.model.buffers, self.model.operatorCodes = [schema.BufferT()], []
        self.graph.tensors, self.graph.operators = [], []

    def tensor(self, shape, data=None):
        """Add a tensor of float32, or a constant of int32."""
        tensor = schema.TensorT()
        tensor.shape, tensor.name = list(shape), f"t{len(self.graph.tensors)}"
        tensor.type, tensor.buffer = schema.TensorType.FLOAT32, 0
        if data is not None:
            buffer = schema.BufferT()
            buffer.data = np.frombuffer(np.array(data, np.int32).tobytes(), np.uint8)
            tensor.type, tensor.buffer = schema.TensorType.INT32, len(self.model.buffers)
            self.model.buffers.append(buffer)
        self.graph.tensors.append(tensor)
        return len(self.graph.tensors) - 1

    def add(self, kind, inputs, shape, options=None):
        """Add an operation and its output."""
        code, operator = schema.OperatorCodeT(), schema.OperatorT()
        code.builtinCode = code.deprecatedBuiltinCode = getattr(schema.BuiltinOperator, kind)
        code.version = 1
        operator.opcodeIndex = len(self.model.operatorCodes)
        self.model.operatorCodes.append(code)
        operator.inputs, operator.outputs = list(inputs), [self.tensor(shape)]
        if options is not None:
            name = type(options).__name__.removesuffix("T")
            operator.builtinOptionsType = getattr(schema.BuiltinOptions, name)
            operator.builtinOptions = options
        self.graph.operators.append(operator)
        return operator.outputs[0]

    def write(self, path, inputs, outputs):
        """Write the file."""
        self.graph.inputs, self.graph.outputs = list(inputs), list(outputs)
        builder = flatbuffers.Builder(1024)
        builder.Finish(self.model.Pack(builder), b"TFL3")
        path.write_bytes(bytes(builder.Output()))


def write_palms(path):
    """Write a detector whose outputs are the maxima of 8 x 8 pixels, followed by zeros."""
    writer, pool = Writer(), schema.Pool2DOptionsT()
    pool.padding = schema.Padding.VALID
    pool.strideW = pool.strideH = pool.filterWidth = pool.filterHeight = 8
    x = writer.tensor((1, 192, 192, 3))
    pooled = writer.add("MAX_POOL_2D", [x], (1, 24, 24, 3), pool)
    flat = writer.add("RESHAPE", [pooled, writer.tensor((3,), [1, 1728, 1])], (1, 1728, 1))
    long = writer.tensor((3, 2), [[0, 0], [0, 288], [0, 0]])
    logits = writer.add("PAD", [flat, long], (1, 2016, 1), schema.PadOptionsT())
    wide = writer.tensor((3, 2), [[0, 0], [0, 0], [0, 17]])
    boxes = writer.add("PAD", [logits, wide], (1, 2016, 18), schema.PadOptionsT())
    writer.write(path, [x], [boxes, logits])


def test_an_image_is_scaled_to_one_and_the_next_one_is_run_by_itself(tmp_path):
    write_palms(tmp_path / "palms.tflite")
    networks = HandNetworks(tmp_path / "palms.tflite", tmp_path / "palms.tflite", threads=1)
    images = np.zeros((2, 192, 192, 3), np.uint8)
    images[1, :8, :8] = [51, 102, 255]
    (boxes, dark), (_, logits) = map(networks.palms, images)
    assert boxes.shape == (2016, 18)
    np.testing.assert_allclose(dark, 0)
    np.testing.assert_allclose(logits[:4], [0.2, 0.4, 1, 0], atol=1e-6)


def test_a_file_that_is_not_a_network_is_refused(tmp_path):
    (tmp_path / "palms.tflite").write_bytes(b"no network")
    with pytest.raises(InputError, match="not a model that LiteRT can run"):
        HandNetworks(tmp_path / "palms.tflite", tmp_path / "palms.tflite", threads=1)


def test_without_litert_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(InputError, match=r"egosim-jax\[video\]"):
        HandNetworks(tmp_path / "palms.tflite", tmp_path / "palms.tflite", threads=1)


def test_given_weights_are_verified_before_they_are_run(tmp_path):
    for name in (PALMS, LANDMARKS):
        (tmp_path / name).write_bytes(b"other weights")
    with pytest.raises(InputError, match=r"palm_detection_full\.tflite has SHA-256"):
        LandmarkHands(weights=tmp_path)(BLACK)


def test_an_annotation_reads_the_weights_that_it_is_given(tmp_path):
    hands = AnnotateConfig(hand_weights=tmp_path).build().hands
    with pytest.raises(InputError, match=r"palm_detection_full\.tflite cannot be read"):
        hands(BLACK)


def test_offline_without_weights_is_refused_with_a_fix(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(InputError, match="egosim models fetch hands"):
        LandmarkHands(offline=True)(BLACK)
