"""Columns of Parquet files, with sizes checked before they are read in a child process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.bounded import open_regular, quote_path, quote_text
from egosim_jax.io.untrusted.isolated import read_file
from egosim_jax.types import InputError

MAX_COLUMN_BYTES = 1 << 26
"""Largest size of the columns that are read, in bytes, unpacked."""
MAX_VALUES = 1 << 23
"""Maximum number of values of the columns that are read, each 32 bytes or more in Python."""
MAX_IMAGES_BYTES = 1 << 27
"""Maximum size of the encoded images that one call returns, in bytes."""


def read_parquet(
    path: Path, columns: Sequence[str], *, optional: Sequence[str] = ()
) -> dict[str, list[Any]]:
    """Return the values of columns, as Python values, by name; only these columns are read.

    Raises `InputError` if a column that is not optional is missing or holds something other than
    numbers, texts and lists of them, or if the file is damaged or declares more than is read.
    """
    found = read_file(_read, path, columns, optional)
    return {
        name: values.tolist() if isinstance(values, np.ndarray) else values
        for name, values in found.items()
    }


def read_image_rows(path: Path, column: str, episode: int, frames: Sequence[int]) -> list[bytes]:
    """Return the encoded images of some frames of an episode, from a LeRobot table.

    Raises `InputError` as `read_parquet` does, if a frame is missing or has no bytes, and for more
    than `MAX_IMAGES_BYTES`.
    """
    return read_file(_read_images, path, column, episode, list(frames))


def _read_images(path: Path, column: str, episode: int, frames: list[int]) -> list[bytes]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    name, found, size = quote_path(path), {}, 0
    wanted = set(frames)
    with open_regular(path) as file:
        try:
            opened = pq.ParquetFile(file)
            if column not in opened.schema_arrow.names:
                raise InputError(f"{name} has no column {quote_text(column)}.")
            columns = [column, "episode_index", "frame_index"]
            for batch in opened.iter_batches(batch_size=16, columns=columns, use_threads=False):
                numbers = [batch.column(n).to_pylist() for n in (1, 2)]
                for row, (owner, frame) in enumerate(zip(*numbers, strict=True)):
                    if owner == episode and frame in wanted:
                        image = batch.column(0)[row].as_py()
                        data = image.get("bytes") if isinstance(image, dict) else None
                        if not isinstance(data, bytes):
                            raise InputError(
                                f"{name}: frame {frame} of {quote_text(column)} has no bytes of an "
                                "image. Export the dataset with its images."
                            )
                        size += len(data)
                        if size > MAX_IMAGES_BYTES:
                            raise InputError(
                                f"{name} has more than {MAX_IMAGES_BYTES:,} bytes in "
                                f"{len(frames)} images: store smaller images, or a video."
                            )
                        found[frame] = data
        except (pa.ArrowException, OSError, ValueError) as error:
            if isinstance(error, (InputError, MemoryError)):
                raise
            raise InputError(
                f"{name} is not a readable Parquet file: {quote_text(str(error))}."
            ) from error
    if missing := [frame for frame in frames if frame not in found]:
        raise InputError(f"{name} has no image of frame {missing[0]} of episode {episode}.")
    return [found[frame] for frame in frames]


def _read(
    path: Path, columns: Sequence[str], optional: Sequence[str]
) -> dict[str, np.ndarray | list[Any]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    name = quote_path(path)
    with open_regular(path) as file:
        try:
            opened = pq.ParquetFile(file)
            found = opened.schema_arrow.names
            absent = [column for column in columns if column not in found]
            if absent:
                raise InputError(
                    f"{name} has no column {quote_text(', '.join(absent))}; it has "
                    f"{quote_text(', '.join(found))}."
                )
            wanted = [*columns, *(column for column in optional if column in found)]
            for column in wanted:
                kind = opened.schema_arrow.field(column).type
                if not _is_plain(kind):
                    raise InputError(
                        f"Column {quote_text(column)} of {name} has values of type "
                        f"{quote_text(str(kind))}: numbers, texts and lists of them are read. "
                        "Write the column as one of these."
                    )
            _check_sizes(opened.metadata, wanted, name)
            # Column by column: Arrow's copy of one is freed before the next one is read.
            return {
                column: _values(opened.read(columns=[column], use_threads=False).column(column))
                for column in wanted
            }
        except (pa.ArrowException, OSError, ValueError) as error:
            if isinstance(error, (InputError, MemoryError)):
                raise
            raise InputError(
                f"{name} is not a readable Parquet file: {quote_text(str(error))}."
            ) from error


def _is_plain(kind: Any) -> bool:
    """Return whether values are numbers, texts or lists; a million dates take 20 s in Python."""
    import pyarrow.types as of

    outer = of.is_dictionary, of.is_list, of.is_large_list, of.is_fixed_size_list
    if any(is_outer(kind) for is_outer in outer):
        return _is_plain(kind.value_type)
    plain = of.is_integer, of.is_floating, of.is_boolean, of.is_string, of.is_large_string
    return of.is_null(kind) or any(is_plain(kind) for is_plain in plain)


def _values(column: Any) -> np.ndarray | list[Any]:
    """Return the values of a column; numbers without gaps as an array, a quarter of the size."""
    import pyarrow as pa

    kind = column.type
    if column.null_count or not (pa.types.is_integer(kind) or pa.types.is_float64(kind)):
        return column.to_pylist()
    return column.to_numpy()


def _check_sizes(metadata: Any, wanted: Sequence[str], name: str) -> None:
    size = values = 0
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        for index in range(group.num_columns):
            chunk = group.column(index)
            # The values of a list column are at `column.list.element`.
            if any(f"{chunk.path_in_schema}.".startswith(f"{column}.") for column in wanted):
                size += max(0, chunk.total_uncompressed_size)
                values += max(0, chunk.num_values)
    if values > MAX_VALUES or size > MAX_COLUMN_BYTES:
        raise InputError(
            f"{name} declares {values:,} values and {size:,} bytes to read: at most "
            f"{MAX_VALUES:,} values and {MAX_COLUMN_BYTES:,} bytes are read. Split the file."
        )
