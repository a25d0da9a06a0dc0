"""Tiny TensorFlow Lite files for tests, written with the schema that LiteRT ships."""

from pathlib import Path

import flatbuffers
import numpy as np
from ai_edge_litert import schema_py_generated as schema

_TYPES = {"float32": 0, "float16": 1, "int32": 2}


class Writer:
    """Graph under construction: tensors by number, operations in order."""

    def __init__(self):
        self.model = schema.ModelT()
        self.model.version = 3
        self.model.buffers = [schema.BufferT()]
        self.model.operatorCodes = []
        self.graph = schema.SubGraphT()
        self.graph.tensors, self.graph.operators = [], []

    def tensor(self, shape, data=None):
        """Add a tensor, with values for a constant."""
        tensor = schema.TensorT()
        tensor.shape = list(shape)
        tensor.name = f"t{len(self.graph.tensors)}"
        tensor.type = _TYPES["float32" if data is None else str(data.dtype)]
        tensor.buffer = 0
        if data is not None:
            buffer = schema.BufferT()
            buffer.data = np.frombuffer(data.tobytes(), np.uint8)
            tensor.buffer = len(self.model.buffers)
            self.model.buffers.append(buffer)
        self.graph.tensors.append(tensor)
        return len(self.graph.tensors) - 1

    def constant(self, data):
        """Add a constant; one in half precision is followed by its conversion."""
        number = self.tensor(data.shape, data)
        if data.dtype == np.float16:
            return self.add("DEQUANTIZE", [number], data.shape)
        return number

    def add(self, kind, inputs, shape, options=None, **values):
        """Add an operation and its output; `options` is the class of its options."""
        code = schema.OperatorCodeT()
        code.builtinCode = getattr(schema.BuiltinOperator, kind)
        code.deprecatedBuiltinCode = min(code.builtinCode, 127)
        code.version = 3 if kind == "DEQUANTIZE" else 1
        operator = schema.OperatorT()
        operator.opcodeIndex = len(self.model.operatorCodes)
        self.model.operatorCodes.append(code)
        operator.inputs, operator.outputs = list(inputs), [self.tensor(shape)]
        if options is not None:
            operator.builtinOptionsType = getattr(schema.BuiltinOptions, options)
            operator.builtinOptions = getattr(schema, f"{options}T")()
            for name, value in values.items():
                assert hasattr(operator.builtinOptions, name)
                setattr(operator.builtinOptions, name, value)
        self.graph.operators.append(operator)
        return operator.outputs[0]

    def write(self, path: Path, inputs, outputs):
        """Write the file."""
        self.graph.inputs, self.graph.outputs = list(inputs), list(outputs)
        self.model.subgraphs = [self.graph]
        builder = flatbuffers.Builder(1024)
        builder.Finish(self.model.Pack(builder), b"TFL3")
        path.write_bytes(bytes(builder.Output()))


def write_tiny_network(path: Path, seed: int = 0) -> None:
    """Write a network with every operation of MediaPipe's, of 12 x 12 pixels."""
    rng = np.random.default_rng(seed)

    def weights(*shape, dtype=np.float16):
        return writer.constant(rng.normal(0, 0.5, shape).astype(dtype))

    writer = Writer()
    conv = {"strideW": 1, "strideH": 1, "dilationWFactor": 1, "dilationHFactor": 1}
    x = writer.tensor((1, 12, 12, 3))
    y = writer.add(
        "CONV_2D",
        [x, weights(8, 5, 5, 3), weights(8)],
        (1, 6, 6, 8),
        "Conv2DOptions",
        **{**conv, "padding": 0, "strideW": 2, "strideH": 2},
    )
    y = writer.add("PRELU", [y, weights(1, 1, 8)], (1, 6, 6, 8))
    z = writer.add(
        "DEPTHWISE_CONV_2D",
        [y, weights(1, 3, 3, 8), weights(8)],
        (1, 6, 6, 8),
        "DepthwiseConv2DOptions",
        **{**conv, "padding": 0, "depthMultiplier": 1, "fusedActivationFunction": 3},
    )
    y = writer.add("ADD", [y, z], (1, 6, 6, 8), "AddOptions", fusedActivationFunction=1)
    pooled = writer.add(
        "MAX_POOL_2D",
        [y],
        (1, 3, 3, 8),
        "Pool2DOptions",
        padding=0,
        strideW=2,
        strideH=2,
        filterWidth=2,
        filterHeight=2,
    )
    paddings = np.array([[0, 0], [0, 0], [0, 0], [0, 4]], np.int32)
    padded = writer.add("PAD", [pooled, writer.constant(paddings)], (1, 3, 3, 12), "PadOptions")
    large = writer.add(
        "RESIZE_BILINEAR",
        [padded, writer.constant(np.array([6, 6], np.int32))],
        (1, 6, 6, 12),
        "ResizeBilinearOptions",
        halfPixelCenters=True,
    )
    narrow = writer.add(
        "CONV_2D",
        [large, weights(2, 1, 1, 12, dtype=np.float32), weights(2)],
        (1, 6, 6, 2),
        "Conv2DOptions",
        **{**conv, "padding": 1},
    )
    rows = writer.add(
        "RESHAPE", [narrow, writer.constant(np.array([1, 72, 1], np.int32))], (1, 72, 1)
    )
    other = writer.add(
        "RESHAPE", [padded, writer.constant(np.array([1, 108, 1], np.int32))], (1, 108, 1)
    )
    joined = writer.add("CONCATENATION", [rows, other], (1, 180, 1), "ConcatenationOptions", axis=1)
    mean = writer.add(
        "MEAN", [large, writer.constant(np.array([1, 2], np.int32))], (1, 12), "ReducerOptions"
    )
    linear = writer.add(
        "FULLY_CONNECTED", [mean, weights(5, 12), weights(5)], (1, 5), "FullyConnectedOptions"
    )
    chance = writer.add("LOGISTIC", [linear], (1, 5))
    writer.write(path, [x], [joined, linear, chance])
