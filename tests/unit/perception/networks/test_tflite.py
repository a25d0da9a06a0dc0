"""TensorFlow Lite files as JAX programs: the numbers of LiteRT, and damaged files refused."""

import numpy as np
import pytest

from egosim_jax.annotate.config import AnnotateConfig
from egosim_jax.perception.networks.hands import BatchedNetwork, JaxHandNetworks
from egosim_jax.perception.networks.tflite import read_program
from egosim_jax.types import InputError

pytest.importorskip("ai_edge_litert")

from tests.tflite import Writer, write_tiny_network


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    path = tmp_path_factory.mktemp("tflite") / "network.tflite"
    write_tiny_network(path)
    return path


def litert(path, pictures):
    from ai_edge_litert.interpreter import Interpreter

    interpreter = Interpreter(str(path))
    interpreter.allocate_tensors()
    results = []
    for picture in pictures:
        place = interpreter.get_input_details()[0]["index"]
        interpreter.set_tensor(place, picture[None].astype(np.float32) / 255)
        interpreter.invoke()
        found = [interpreter.get_tensor(o["index"]) for o in interpreter.get_output_details()]
        results.append([value.copy() for value in found])
    return [np.concatenate(result) for result in zip(*results, strict=True)]


def test_every_operation_gives_the_numbers_of_litert_in_a_batch(network):
    pictures = np.random.default_rng(1).integers(0, 256, (3, 12, 12, 3), dtype=np.uint8)
    for ours, theirs in zip(
        BatchedNetwork(network)(pictures), litert(network, pictures), strict=True
    ):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, atol=2e-5)


def test_weights_in_half_precision_are_converted_when_they_are_read(network):
    program = read_program(network)
    assert {w.dtype for w in program.weights.values()} == {np.dtype(np.float32)}
    assert "DEQUANTIZE" not in {step.kind for step in program.operations}


def test_an_operation_that_is_not_supported_is_named(tmp_path):
    writer = Writer()
    x = writer.tensor((1, 2, 2, 3))
    y = writer.add("TANH", [x], (1, 2, 2, 3))
    writer.write(tmp_path / "tanh.tflite", [x], [y])
    with pytest.raises(InputError, match="operation TANH is not supported"):
        read_program(tmp_path / "tanh.tflite")


def test_an_option_that_is_not_supported_is_named(tmp_path):
    writer = Writer()
    x = writer.tensor((1, 2, 2, 3))
    size = writer.constant(np.array([4, 4], np.int32))
    y = writer.add(
        "RESIZE_BILINEAR", [x, size], (1, 4, 4, 3), "ResizeBilinearOptions", alignCorners=True
    )
    writer.write(tmp_path / "resize.tflite", [x], [y])
    with pytest.raises(InputError, match="RESIZE_BILINEAR with alignCorners True"):
        read_program(tmp_path / "resize.tflite")


def test_a_tensor_that_is_larger_than_its_bytes_is_refused(tmp_path):
    writer = Writer()
    x = writer.tensor((1, 2, 2, 3))
    y = writer.add("PRELU", [x, writer.constant(np.ones((1, 1, 3), np.float32))], (1, 2, 2, 3))
    writer.graph.tensors[1].shape = [1, 1, 3000]
    writer.write(tmp_path / "large.tflite", [x], [y])
    with pytest.raises(InputError, match="tensor 1 is cut off"):
        read_program(tmp_path / "large.tflite")


def test_damaged_bytes_are_refused_or_read_but_never_crash(network, tmp_path):
    data = network.read_bytes()
    rng = np.random.default_rng(0)
    damaged = tmp_path / "damaged.tflite"
    refused = 0
    for _ in range(60):
        changed = bytearray(data)
        for place in rng.integers(0, len(data), 8):
            changed[place] = rng.integers(256)
        damaged.write_bytes(changed[: rng.integers(len(data) // 2, len(data) + 1)])
        try:
            read_program(damaged)
        except InputError:
            refused += 1
    assert refused > 30


def test_an_annotation_finds_hands_by_jax_on_request(tmp_path):
    config = AnnotateConfig(hand_weights=tmp_path, hands="jax")
    hands = config.build().hands
    assert hands.networks == JaxHandNetworks(tmp_path)
    with pytest.raises(InputError, match=r"palm_detection_full\.tflite cannot be read"):
        hands(np.zeros((1, 48, 64, 3), np.uint8))
