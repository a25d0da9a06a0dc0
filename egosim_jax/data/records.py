"""Records: one clip, or one window of a clip, serialized as a safetensors file.

The header of the file holds the record's metadata as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from egosim_jax.io.bounded import parse_json, quote_text
from egosim_jax.io.mapped import CODES
from egosim_jax.types import InputError

_DTYPES = {code: CODES[code] for code in ("BOOL", "U8", "I32", "I64", "F16", "BF16", "F32")}
DTYPES = {dtype.name: dtype for dtype in _DTYPES.values()}
"""Dtypes that a record can hold, by name."""


class RecordError(InputError):
    """An error for a record that cannot be read; its message names the file."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Named arrays and metadata of one clip, or of one window of a clip."""

    arrays: Mapping[str, np.ndarray]
    """Read-only arrays by name."""
    metadata: Mapping[str, Any]
    """JSON values by key: `video_id`, `prompt`, `extra` and the writer's further keys."""


def to_bytes(record: Record) -> bytes:
    """Serialize a record; `from_bytes` returns bit-identical arrays."""
    arrays = {name: np.asarray(array, order="C") for name, array in record.arrays.items()}
    return safetensors.numpy.save(arrays, metadata={"json": json.dumps(dict(record.metadata))})


def from_bytes(data: bytes, *, name: str = "the record") -> Record:
    """Parse the bytes of a record. Raises `RecordError` if they are invalid."""
    try:
        arrays = {
            key: np.frombuffer(tensor["data"], _DTYPES[tensor["dtype"]]).reshape(tensor["shape"])
            # safetensors returns tensors in arbitrary order; records must be reproducible.
            for key, tensor in sorted(safetensors.deserialize(data), key=lambda pair: pair[0])
        }
        length = int.from_bytes(data[:8], "little")
        header = parse_json(data[8 : 8 + length], source="its header")
        metadata = parse_json(header["__metadata__"]["json"].encode(), source="its metadata")
        texts = {key: metadata.get(key, "") for key in ("video_id", "prompt")}
        extra = metadata.get("extra", {})
        if not all(isinstance(text, str) for text in [*texts.values(), *extra.values()]):
            raise TypeError("video_id, prompt and extra must be text")
    except (safetensors.SafetensorError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise RecordError(f"{name} is not a valid record: {quote_text(str(error))}.") from error
    return Record(arrays=arrays, metadata=metadata)


def stacked(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return rows of equal arrays as one array of each name, with a leading axis of the rows."""
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
