"""TensorFlow Lite files of float networks as JAX programs, for any batch size.

The flatbuffer is untrusted: what it declares is bounded and checked against the bytes that are
there before anything is computed. Weights in float16 become float32, as in LiteRT. Supported are
the operations of MediaPipe's hand networks; another one is refused by name.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from egosim_jax.io.untrusted.bounded import quote_path, quote_text, read_bytes
from egosim_jax.types import InputError

MAX_BYTES = 1 << 26
"""Largest file that is read, in bytes."""
MAX_COUNT = 4096
"""Maximum number of tensors, operations and buffers of a file."""
MAX_ELEMENTS = 1 << 26
"""Maximum number of elements of one tensor."""
MAX_SIZE = 256
"""Largest stride, dilation and window."""
_DTYPES = {0: np.float32, 1: np.float16, 2: np.int32}
_PADDING = {0: "SAME", 1: "VALID"}
_PICTURES = ("NHWC", "HWIO", "NHWC")

Options = Mapping[str, Any]
Arrays = Sequence[Any]


@dataclass(frozen=True)
class Operation:
    """One step of a program."""

    kind: str
    """Name in TensorFlow Lite, such as CONV_2D."""
    inputs: tuple[int, ...]
    """Tensors that it reads; -1 for none."""
    output: int
    """Tensor that it writes."""
    options: Options
    """Options by their name in the schema."""


@dataclass(frozen=True)
class Program:
    """Network of a file: a sequence of operations on numbered tensors."""

    input: int
    """Tensor of the pictures."""
    outputs: tuple[int, ...]
    """Tensors of the results."""
    shapes: Mapping[int, tuple[int, ...]]
    """Shape of each tensor, for a batch of one."""
    constants: Mapping[int, np.ndarray]
    """Weights, and what defines shapes."""
    operations: tuple[Operation, ...]

    @property
    def weights(self) -> dict[int, np.ndarray]:
        """Constants in floating point, by tensor."""
        return {i: value for i, value in self.constants.items() if value.dtype == np.float32}

    def __call__(self, weights: Mapping[int, jax.Array], pictures: jax.Array) -> list[jax.Array]:
        """Return the outputs for a batch of pictures `b h w c`."""
        values: dict[int, Any] = {**self.constants, **weights, self.input: pictures}
        for step in self.operations:
            arrays = [values[i] if i >= 0 else None for i in step.inputs]
            result = _OPERATIONS[step.kind](arrays, step.options)
            values[step.output] = _activated(result, step.options)
        return [values[i] for i in self.outputs]


def read_program(path: Path) -> Program:
    """Read a TensorFlow Lite file. Raises `InputError` if it is damaged or not supported."""
    from ai_edge_litert import schema_py_generated as schema

    name = quote_path(path)
    data = read_bytes(path, limit=MAX_BYTES)
    if data[4:8] != b"TFL3":
        raise InputError(f"{name} is not a TensorFlow Lite file.")
    with _refusing(name):
        model = schema.Model.GetRootAsModel(data, 0)
        _check(model.SubgraphsLength() == 1, "it has several graphs")
        graph: Any = model.Subgraphs(0)
        counts = graph.TensorsLength(), graph.OperatorsLength(), model.BuffersLength()
        _check(max(*counts, model.OperatorCodesLength()) <= MAX_COUNT, "it has too many parts")
        _check(graph.InputsLength() == 1, "it has several inputs")
        shapes, constants = _tensors(model, graph)
        operations = tuple(_operations(schema, model, graph, shapes, constants))
        program = Program(
            graph.Inputs(0),
            tuple(graph.Outputs(i) for i in range(min(graph.OutputsLength(), MAX_COUNT))),
            shapes,
            constants,
            operations,
        )
        _check_shapes(program)
    return program


def _tensors(model: Any, graph: Any) -> tuple[dict[int, tuple[int, ...]], dict[int, np.ndarray]]:
    """Return the shapes of all tensors, and the values of those that have any."""
    shapes, constants = {}, {}
    for i in range(graph.TensorsLength()):
        tensor = graph.Tensors(i)
        shape = tuple(int(n) for n in tensor.ShapeAsNumpy()) if tensor.ShapeLength() else ()
        _check(all(n > 0 for n in shape) and len(shape) <= 4, f"tensor {i} has shape {shape[:5]}")
        _check(math.prod(shape) <= MAX_ELEMENTS, f"tensor {i} is too large")
        _check(tensor.Type() in _DTYPES, f"tensor {i} has element type {tensor.Type()}")
        shapes[i] = shape
        _check(0 <= tensor.Buffer() < model.BuffersLength(), f"tensor {i} has no buffer")
        buffer = model.Buffers(tensor.Buffer())
        if not buffer.DataLength():
            continue
        dtype = np.dtype(_DTYPES[tensor.Type()]).newbyteorder("<")
        values = buffer.DataAsNumpy()
        _check(values.nbytes == math.prod(shape) * dtype.itemsize, f"tensor {i} is cut off")
        array = values.view(dtype).reshape(shape)
        constants[i] = array.astype(np.float32 if array.dtype.kind == "f" else np.int32)
    return shapes, constants


def _operations(
    schema: Any,
    model: Any,
    graph: Any,
    shapes: Mapping[int, tuple[int, ...]],
    constants: dict[int, np.ndarray],
) -> Iterator[Operation]:
    """Yield the operations in order; constants in half precision are converted at once."""
    names = {value: name for name, value in vars(schema.BuiltinOperator).items()}
    for i in range(graph.OperatorsLength()):
        operator = graph.Operators(i)
        code = model.OperatorCodes(operator.OpcodeIndex())
        kind = str(names.get(max(code.BuiltinCode(), code.DeprecatedBuiltinCode())))
        lengths = operator.InputsLength(), operator.OutputsLength()
        _check(1 <= lengths[0] <= 8 and lengths[1] == 1, f"{kind} has {lengths} tensors")
        inputs = tuple(operator.Inputs(j) for j in range(lengths[0]))
        output = operator.Outputs(0)
        _check(set(inputs) - {-1} <= set(shapes) and output in shapes, f"{kind} has no tensor")
        if kind == "DEQUANTIZE" and inputs[0] in constants:
            constants[output] = constants[inputs[0]]
            continue
        _check(kind in _OPERATIONS, f"operation {kind} is not supported")
        table = schema.OperatorT.InitFromObj(operator).builtinOptions
        options = {} if table is None else dict(vars(table))
        if kind == "RESHAPE":
            options["shape"] = shapes[output][1:]
        for name, wanted in _FIXED.get(kind, {}).items():
            _check(options.get(name) == wanted, f"{kind} with {name} {options.get(name)}")
        for name in _SIZES:
            _check(0 < options.get(name, 1) <= MAX_SIZE, f"{kind} with {name} {options.get(name)}")
        yield Operation(kind, inputs, output, options)


def _check_shapes(program: Program) -> None:
    """Compute all shapes without values, and compare them with those that the file declares."""
    everything = tuple(step.output for step in program.operations)
    _check(set(program.outputs) <= set(everything), "an output is not computed")
    program = replace(program, outputs=everything)
    weights = {i: jax.ShapeDtypeStruct(w.shape, w.dtype) for i, w in program.weights.items()}
    pictures = jax.ShapeDtypeStruct(program.shapes[program.input], np.float32)
    for i, found in zip(program.outputs, jax.eval_shape(program, weights, pictures), strict=True):
        _check(found.shape == program.shapes[i], f"tensor {i} has shape {found.shape}")


def _activated(x: jax.Array, options: Options) -> jax.Array:
    match options.get("fusedActivationFunction", 0):
        case 0:
            return x
        case 1:
            return jnp.maximum(x, 0)
        case 3:
            return jnp.clip(x, 0, 6)
        case other:
            raise ValueError(f"activation function {other} is not supported")


def _conv(arrays: Arrays, options: Options) -> jax.Array:
    x, kernel, *bias = arrays
    return _biased(_convolved(x, jnp.transpose(kernel, (1, 2, 3, 0)), 1, options), bias)


def _depthwise(arrays: Arrays, options: Options) -> jax.Array:
    x, kernel, *bias = arrays
    kernel = jnp.transpose(kernel, (1, 2, 0, 3))
    return _biased(_convolved(x, kernel, x.shape[-1], options), bias)


def _convolved(x: Any, kernel: jax.Array, groups: int, options: Options) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x,
        kernel,
        (options["strideH"], options["strideW"]),
        _PADDING[options["padding"]],
        rhs_dilation=(options["dilationHFactor"], options["dilationWFactor"]),
        dimension_numbers=_PICTURES,
        feature_group_count=groups,
        precision=jax.lax.Precision.HIGHEST,
    )


def _fully_connected(arrays: Arrays, options: Options) -> jax.Array:
    x, kernel, *bias = arrays
    return _biased(jnp.dot(x, kernel.T, precision=jax.lax.Precision.HIGHEST), bias)


def _biased(x: jax.Array, bias: Arrays) -> jax.Array:
    return x if not bias or bias[0] is None else x + bias[0]


def _max_pool(arrays: Arrays, options: Options) -> jax.Array:
    window = (1, options["filterHeight"], options["filterWidth"], 1)
    strides = (1, options["strideH"], options["strideW"], 1)
    padding = _PADDING[options["padding"]]
    return jax.lax.reduce_window(arrays[0], -jnp.inf, jax.lax.max, window, strides, padding)


def _resize(arrays: Arrays, options: Options) -> jax.Array:
    x, size = arrays
    shape = (x.shape[0], *(int(n) for n in size), x.shape[-1])
    return jax.image.resize(x, shape, "bilinear", antialias=False)


def _mean(arrays: Arrays, options: Options) -> jax.Array:
    axes = tuple(int(a) for a in np.atleast_1d(arrays[1]))
    return jnp.mean(arrays[0], axis=axes, keepdims=options["keepDims"])


_OPERATIONS: dict[str, Callable[[Arrays, Options], jax.Array]] = {
    "ADD": lambda arrays, _: arrays[0] + arrays[1],
    "CONCATENATION": lambda arrays, options: jnp.concatenate(arrays, axis=options["axis"]),
    "CONV_2D": _conv,
    "DEPTHWISE_CONV_2D": _depthwise,
    "FULLY_CONNECTED": _fully_connected,
    "LOGISTIC": lambda arrays, _: jax.nn.sigmoid(arrays[0]),
    "MAX_POOL_2D": _max_pool,
    "MEAN": _mean,
    "PAD": lambda arrays, _: jnp.pad(arrays[0], np.asarray(arrays[1])),
    "PRELU": lambda arrays, _: jnp.where(arrays[0] >= 0, arrays[0], arrays[1] * arrays[0]),
    "RESHAPE": lambda arrays, options: arrays[0].reshape(-1, *options["shape"]),
    "RESIZE_BILINEAR": _resize,
}
_FIXED: dict[str, Options] = {
    "DEPTHWISE_CONV_2D": {"depthMultiplier": 1},
    "FULLY_CONNECTED": {"weightsFormat": 0, "keepNumDims": False},
    "RESIZE_BILINEAR": {"alignCorners": False, "halfPixelCenters": True},
}
"""Options of which only one value is supported."""
_SIZES = (
    "strideH",
    "strideW",
    "dilationHFactor",
    "dilationWFactor",
    "filterHeight",
    "filterWidth",
)
_DAMAGE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, struct.error)


def _check(holds: bool, problem: str) -> None:
    if not holds:
        raise ValueError(problem)


@contextmanager
def _refusing(name: str) -> Iterator[None]:
    """Turn exceptions of parsing untrusted bytes into `InputError`."""
    try:
        yield
    except _DAMAGE as error:
        raise InputError(
            f"{name} is damaged or not a supported network: {quote_text(str(error))}."
        ) from error
