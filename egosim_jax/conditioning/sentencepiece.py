"""Tokenizers of SentencePiece's unigram models (`spiece.model`), as T5's releases have them.

The file is a protocol buffer: pieces with their log probability and kind, the kind of the model,
and a table that normalizes characters. Only these fields are needed and read, with bounds. The id
of a piece is its index. A space is written ▁, also before the text, and several spaces count as
one. (Kudo & Richardson 2018, SentencePiece.)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egosim_jax.io.bounded import quote_path, read_bytes
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from tokenizers import Tokenizer

MAX_BYTES, MAX_PIECES = 64 << 20, 1 << 20
"""Largest file in bytes, and most pieces."""
UNIGRAM, UNKNOWN, BYTE = 1, 2, 6
"""Number of the unigram model, and of the kinds of pieces for the unknown and for bytes."""
PIECES, TRAINER, NORMALIZER = 1, 2, 3
"""Fields of the model."""
TEXT, SCORE, KIND = 1, 2, 3
"""Fields of a piece."""
MODEL_KIND, CHARACTERS = 3, 2
"""Field of the trainer with the kind of the model, and of the normalizer with its table."""
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types of protocol buffers."""
EXTRA_IDS = 100
"""Sentinels that T5 appends to its pieces."""


def read_spiece(path: Path) -> Tokenizer:
    """Return the tokenizer of a unigram model, with T5's sentinels after its pieces.

    Raises `InputError` for a damaged file and for other models.
    """
    from tokenizers import Regex, Tokenizer, normalizers, pre_tokenizers
    from tokenizers.models import Unigram

    pieces: list[tuple[str, float]] = []
    kind, unknown, characters, by_byte = UNIGRAM, None, b"", False
    try:
        for number, value in fields(read_bytes(path, limit=MAX_BYTES)):
            if number == PIECES:
                found = dict(fields(value))
                pieces.append((found[TEXT].decode(), struct.unpack("<f", found[SCORE])[0]))
                by_byte |= found.get(KIND) == BYTE
                unknown = len(pieces) - 1 if found.get(KIND) == UNKNOWN else unknown
            elif number == TRAINER:
                kind = dict(fields(value)).get(MODEL_KIND, UNIGRAM)
            elif number == NORMALIZER:
                characters = dict(fields(value)).get(CHARACTERS, b"")
    except (ValueError, KeyError, AttributeError, TypeError, IndexError, struct.error) as error:
        raise InputError(f"{quote_path(path)} is damaged: {error}. Copy it again.") from error
    if kind != UNIGRAM or unknown is None or len(pieces) > MAX_PIECES:
        raise InputError(
            f"{quote_path(path)} cannot be read: it must be a unigram model with an unknown piece "
            f"and at most {MAX_PIECES:,} pieces; it has {len(pieces)} pieces of a model of kind "
            f"{kind}. Give the spiece.model of T5."
        )
    pieces += [(f"<extra_id_{number}>", 0.0) for number in reversed(range(EXTRA_IDS))]
    tokenizer = Tokenizer(Unigram(pieces, unk_id=unknown, byte_fallback=by_byte))
    spaces = [normalizers.Strip(left=False, right=True), normalizers.Replace(Regex(" {2,}"), "▁")]
    table = [normalizers.Precompiled(characters)] if characters else []
    tokenizer.normalizer = normalizers.Sequence([*table, *spaces])
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace(replacement="▁", prepend_scheme="always")
    return tokenizer


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of each field of a protocol buffer: an integer, or bytes.

    Raises `ValueError` if it ends inside a field, or has an unknown wire type.
    """
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        wire = key & 7
        if wire == VARINT:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if wire == BYTES:
            size, at = _varint(data, at)
        elif wire in (FIXED32, FIXED64):
            size = 4 if wire == FIXED32 else 8
        else:
            raise ValueError(f"wire type {wire} at byte {at}")
        if at + size > len(data):
            raise ValueError(f"it ends in the field at byte {at}")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return an integer of 7 bits a byte, and the offset after it."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
    raise ValueError(f"an integer of more than 64 bits at byte {at}")
