"""Objects of an RGB-D scene on the command line: found, read from a mask, or segmented."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.types import InputError, object_name

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.types import SceneState

NO_OBJECTS = (
    "no point has an object id, so only what a hand closes on can move, if the perception is "
    "classical. A video has objects if it is annotated at its own size (without --config and "
    "--clips), images if the episode is made with --objects auto or with a mask; in Python, give "
    "object_ids to state_from_depth."
)
"""Warning of a scene without objects, after its name."""


def objects_of(
    chosen: str,
    image: np.ndarray,
    depth_m: np.ndarray,
    intrinsics_px: np.ndarray,
    *,
    detector: Path | None = None,
    phrases: Sequence[str] = (),
) -> tuple[np.ndarray | None, dict[int, str]]:
    """Return the object id of each pixel and the known names by `--objects`.

    `chosen` is auto, none, the file of a mask, or a network and its folder.
    """
    import numpy as np

    if "=" not in chosen and (detector or phrases):
        raise InputError(
            "--detector and --phrases are for networks: give --objects grounded-sam3=FOLDER or "
            "another one."
        )
    if chosen == "none":
        return None, {}
    if chosen == "auto":
        from egosim_jax.state.instances import find_objects

        return find_objects(image, depth_m, intrinsics_px), {}
    if "=" in chosen:
        from egosim_jax.annotate.config import build_segmenter

        if not phrases:
            raise InputError("A network needs the names of the objects to segment. (--phrases)")
        segmenter = build_segmenter(chosen, detector, option="--objects")
        ids, names = segmenter(image[None], tuple(phrases), None)
        return np.maximum(ids[0], 0), {n: name for n, name in names.items() if n > 0}
    return _read_mask(Path(chosen), image.shape[:2]), {}


def _read_mask(path: Path, size: tuple[int, ...]) -> np.ndarray:
    """Return the object ids of a PNG: gray levels, or indices of a palette."""
    import numpy as np

    from egosim_jax.io.bounded import quote_path, read_bytes
    from egosim_jax.io.images import MAX_IMAGE_BYTES, decode_labels

    if path.suffix.lower() != ".png":
        raise InputError(
            f"--objects is {quote_path(path)}: it must be auto, none, a .png of object ids, or a "
            "network and its folder, such as grounded-sam3=FOLDER."
        )
    ids = decode_labels(read_bytes(path, limit=MAX_IMAGE_BYTES), quote_path(path))
    if ids.shape != size:
        raise InputError(
            f"{quote_path(path)} is {ids.shape[1]}x{ids.shape[0]} and the image "
            f"{size[1]}x{size[0]} pixels: the mask must have one id per pixel of the image. "
            "(--objects)"
        )
    return ids.astype(np.int32)


def names_of(ids: np.ndarray | None, object_names: Mapping[int, str], given: Sequence[str]) -> dict:
    """Return a name for every object: given as ID=NAME, known, or its number."""
    import numpy as np

    numbers = [] if ids is None else np.unique(ids[ids > 0]).tolist()
    names = {number: object_name(number, object_names) for number in numbers}
    for text in given:
        number, equals, name = text.partition("=")
        if not (equals and name.strip() and number.isdecimal() and int(number) in names):
            raise InputError(
                f"--names has {text!r:.60}: it must be ID=NAME with the id of an object, one of "
                f"{', '.join(map(str, numbers)) or 'none'}."
            )
        names[int(number)] = name.strip()
    return names


def describe_objects(state: SceneState) -> str:
    """Return a line with the name and size of each object, or `NO_OBJECTS`."""
    from egosim_jax.runtime.terminal import printable
    from egosim_jax.state.instances import object_sizes

    sizes = object_sizes(state)
    if not sizes:
        return f"no objects: {NO_OBJECTS}"
    listed = [
        f"{state.names.get(number, f'object {number}')}, "
        + " x ".join(f"{max(1, round(100 * side))}" for side in size)
        + " cm"
        for number, size in sizes.items()
    ]
    count = "1 object" if len(sizes) == 1 else f"{len(sizes)} objects"
    return printable(f"{count}: {'; '.join(listed)}")
