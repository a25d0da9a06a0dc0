"""Save and load network weights as safetensors.

A network is one file whose keys are the dotted paths of its nnx state, such as
`blocks.self_attn.q.kernel`. Stacked blocks keep their leading `layers` axis. One error lists all
differences between a file and a network. `convert` reads the checkpoints of other projects.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ml_dtypes
import numpy as np

from egosim_jax.io.atomic import atomic_folder, atomic_write
from egosim_jax.io.bounded import listing, quote, quote_path, quote_text, read_json
from egosim_jax.io.mapped import (
    OURS,
    Tensor,
    TensorInfo,
    digest,
    header,
    read_arrays,
    read_metadata,
    read_safetensors,
    read_weights_hash,
)
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted.pth import SUFFIXES
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from flax import nnx
    from jax.sharding import Mesh

STUDENT = "student.safetensors"
"""Name of the LoRA in a weights folder that makes its denoiser a causal student."""
CHUNKS = "chunks"
"""Metadata of a denoiser that is a causal student: the latent frames of its chunks."""
EIGHT_BITS = (np.dtype(np.int8), np.dtype(ml_dtypes.float8_e4m3fn))
"""Dtypes of kernels in 8 bits, which have a scale of each output channel next to them."""
RECORD = "hashes.json"
"""Name of the file with the hashes of the networks that a weights folder has from another one."""
MAX_LISTED = 12


class WeightsError(InputError):
    """Mismatch between weights and a network; `problems` has one line per differing path."""

    def __init__(self, problems: Sequence[str], *, source: str):
        message = f"{len(problems)} weights of {quote_path(source)} do not match"
        super().__init__(f"{message}: {listing(problems, limit=MAX_LISTED)}.")
        self.problems = list(problems)


def flat_shapes(module: nnx.Module) -> dict[str, tuple[int, ...]]:
    """Return the shape of every parameter and buffer of a module by its dotted path."""
    return {path: tuple(leaf.shape) for path, leaf in _leaves(module).items()}


def _leaves(module: nnx.Module) -> dict[str, nnx.Variable]:
    from flax import nnx

    state = nnx.state(module, nnx.Not(nnx.RngState))
    return {".".join(map(str, path)): leaf for path, leaf in nnx.to_flat_state(state)}


def mismatches(tensors: Mapping[str, Any], expected: Mapping[str, tuple[int, ...]]) -> list[str]:
    """List every path that is missing, unexpected or of another shape than expected."""
    problems = []
    for path in sorted(expected.keys() | tensors.keys()):
        shape = tuple(tensors[path].shape) if path in tensors else None
        if shape is None:
            problems.append(f"{path}: missing; expected {expected[path]}")
        elif path not in expected:
            problems.append(f"{path}: unexpected, with shape {shape}")
        elif shape != expected[path]:
            problems.append(f"{path}: has shape {shape}; expected {expected[path]}")
    return problems


def fill(
    module: nnx.Module,
    tensors: Mapping[str, Any],
    *,
    dtype: np.dtype | str | None = None,
    source: str = "the checkpoint",
    mesh: Mesh | None = None,
) -> None:
    """Set the parameters of a module, concrete or abstract, from tensors by dotted path.

    `dtype` casts the tensors; the default keeps their own. On a mesh, each device reads its own
    shard. Raises `WeightsError` listing every mismatch, before anything is changed.
    """
    problems = mismatches(tensors, flat_shapes(module))
    if problems:
        raise WeightsError(problems, source=source)
    import jax
    from flax import nnx

    from egosim_jax.sharding import state_sharding

    state = nnx.state(module, nnx.Not(nnx.RngState))
    where = {} if mesh is None else dict(nnx.to_flat_state(state_sharding(mesh, state)))
    leaves = nnx.to_flat_state(state)
    arrays = read_arrays(tensors[".".join(map(str, path))] for path, _ in leaves)
    for (path, leaf), tensor in zip(leaves, arrays, strict=True):
        if mesh is None:
            # A copy, since the file may be mapped; `jnp.array` would compile one for each shape.
            value = jax.device_put(np.array(tensor))
        else:
            value = jax.make_array_from_callback(
                tensor.shape, where[path].get_value(), lambda part, t=tensor: np.array(t[part])
            )
        leaf.set_value(value.astype(dtype) if dtype is not None else value)
    nnx.update(module, state)


def hashes(
    folder: Path, *, only: Collection[str] | None = None, student: bool = False
) -> dict[str, str]:
    """Return a hash per network in a weights folder, or per network in `only`.

    Bit-equal weights have the same hash (`weights_hash`). A student in the folder of its teacher
    counts only with `student`: what the teacher alone makes does not depend on it. Raises
    `InputError` for a file that is not the one that `add_others` recorded.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a weights folder. (--weights)")
    files = [
        path
        for path in sorted(folder.glob("[!.]*.safetensors"))  # hidden files are incomplete
        if (path.stem in only if only is not None else student or path.name != STUDENT)
    ]
    digests = {path.stem: read_weights_hash(_linked(path)) for path in files}
    for name, recorded in _record(folder).items():
        if digests.get(name, recorded) != recorded:
            raise InputError(
                f"{quote_path(folder / name)}.safetensors has the hash {digests[name][:12]}…, but "
                f"the folder was made with {quote_text(str(recorded)[:12])}…: it was replaced. "
                f"Put the file back, or remove {RECORD} if the change is right. (--weights)"
            )
    return digests


def check_record(folder: Path, names: Collection[str]) -> None:
    """Raise `InputError` if a network in `names` is not the one that a folder was made with."""
    if recorded := names & _record(folder).keys():
        hashes(folder, only=recorded)


def _record(folder: Path) -> dict[str, Any]:
    """Return the hashes of the networks that a folder has from another one."""
    record = read_json(folder / RECORD) if (folder / RECORD).exists() else {}
    if not isinstance(record, dict):
        raise InputError(f"{quote_path(folder / RECORD)} is not a JSON object of hashes.")
    return record


def save(
    path: Path,
    module: nnx.Module,
    *,
    dtype: str | None = None,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write the weights of a module and text metadata as safetensors, atomically.

    `dtype` casts the tensors; the default keeps their own. All processes must call this together;
    the first process writes.
    """
    tensors = {}
    for name, leaf in _leaves(module).items():
        value = leaf.get_value()
        gathered = gather(value if dtype is None else value.astype(dtype))
        if gathered is not None:
            tensors[name] = gathered
    if tensors:
        write(path, tensors, metadata=metadata)


def write(
    path: Path, tensors: Mapping[str, np.ndarray], *, metadata: Mapping[str, str] | None = None
) -> None:
    """Write tensors and text metadata as safetensors, atomically."""
    arrays = {name: np.asarray(tensor, order="C") for name, tensor in tensors.items()}
    # Wide dtypes first, so that every tensor is aligned to its item size.
    names = sorted(arrays, key=lambda name: (-arrays[name].dtype.itemsize, name))
    bytes_of = {name: arrays[name].reshape(-1).view(np.uint8).data for name in names}
    infos = [TensorInfo(name, arrays[name].shape, arrays[name].dtype) for name in names]
    metadata = {"format": OURS, **(metadata or {})}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(header(infos, metadata, {name: digest(bytes_of[name]) for name in names}))
        for name in names:
            file.write(bytes_of[name])


def layers_in_8_bits(tensors: Mapping[str, Any]) -> dict[str, np.dtype]:
    """Return the dtype of each linear layer whose kernel is in 8 bits, by path."""
    paths = [name.removesuffix(".kernel") for name in tensors if name.endswith(".kernel")]
    dtypes = {path: tensors[f"{path}.kernel"].dtype for path in paths if f"{path}.scale" in tensors}
    return {path: dtype for path, dtype in dtypes.items() if dtype in EIGHT_BITS}


def check_not_in_8_bits(folder: Path, networks: Collection[str], *, use: str, fix: str) -> None:
    """Raise `InputError` if a network of a weights folder is in 8 bits.

    `use` says why that is an error, and `fix` how to correct it.
    """
    for file in (folder / f"{name}.safetensors" for name in networks):
        if file.is_file() and layers_in_8_bits(read_safetensors(file)):
            raise InputError(f"{quote_path(file)} has weights in 8 bits, which {use}. {fix}")


def check_trainable(folder: Path, networks: Collection[str] | None = None) -> None:
    """Raise `InputError` if a network of a weights folder, by default any, is in 8 bits."""
    if networks is None:
        networks = sorted(path.stem for path in folder.glob("[!.]*.safetensors"))
    fix = "Train the weights that they were made of, and quantize the result. (--weights)"
    check_not_in_8_bits(folder, networks, use="cannot be trained", fix=fix)


def add_others(folder: Path, origin: Path, *, student: bool = True) -> None:
    """Give a weights folder the networks and tokenizer of `origin` that it lacks; record hashes.

    Without `student`, the LoRA of a student is omitted.
    """
    paths = [
        path
        for path in sorted(origin.glob("[!.]*"))
        if not (folder / path.name).exists() and (student or path.name != STUDENT)
    ]
    files = [path for path in paths if path.suffix == ".safetensors" and not path.is_dir()]
    # Before the files: whatever is here if this stops has its hash.
    new = {path.stem: read_weights_hash(_linked(path)) for path in files if path.name != STUDENT}
    write_json(folder / RECORD, _record(folder) | new)
    for path in files:
        link_or_copy(path, folder / path.name)
    for path in (path for path in paths if path.is_dir()):
        with atomic_folder(folder / path.name) as temporary:
            shutil.copytree(path, temporary, dirs_exist_ok=True)


def link_or_copy(source: Path, path: Path) -> None:
    """Make a file the same as another: a hard link, which takes no space, or a copy.

    Unlike a symlink it can be copied with its folder, and stays if `source` is replaced.
    """
    with atomic_write(path) as temporary:
        temporary.unlink()
        try:
            os.link(source.resolve(), temporary)
        except OSError:  # on another disk
            shutil.copyfile(source, temporary)


def _linked(path: Path) -> Path:
    """Return the path. Raises `InputError` naming its target if it is a link to nothing."""
    if path.is_symlink() and not path.exists():
        raise InputError(
            f"{quote_path(path)} is a link to {quote_path(os.readlink(path))}, which does not "
            "exist. Put that file back, or copy it to the place of the link. (--weights)"
        )
    return path


def gather(array: Any) -> np.ndarray | None:
    """Gather an array from all processes; return None except in the first process."""
    import jax
    from jax.experimental import multihost_utils

    if not array.is_fully_addressable:
        array = multihost_utils.process_allgather(array, tiled=True)
    return np.asarray(array) if jax.process_index() == 0 else None


def load(path: Path, module: nnx.Module, *, mesh: Mesh | None = None) -> None:
    """Fill a module from a file written by `save` or a conversion (see `fill`)."""
    fill(module, _read(path), source=str(path), mesh=mesh)


def place(folder: Path, abstract: nnx.State, shardings: nnx.State) -> nnx.State:
    """Load the parameters in a weights folder onto devices; each reads its own shard.

    `abstract` has the shapes and dtypes to load, under each network's name. Raises
    `WeightsError` listing every mismatch.
    """
    import jax
    from flax import nnx

    where = dict(nnx.to_flat_state(shardings))
    placed = []
    for network, leaves in groupby(nnx.to_flat_state(abstract), key=lambda item: item[0][0]):
        file = folder / f"{network}.safetensors"
        check_trainable(folder, [str(network)])
        wanted = {".".join(map(str, path[1:])): (path, leaf) for path, leaf in leaves}
        tensors = _read(file)
        shapes = {name: tuple(leaf.shape) for name, (_, leaf) in wanted.items()}
        if problems := mismatches(tensors, shapes):
            raise WeightsError(problems, source=str(file))
        arrays = read_arrays(tensors[name] for name in wanted)
        for (path, leaf), array in zip(wanted.values(), arrays, strict=True):
            value = jax.make_array_from_callback(
                array.shape,
                where[path].get_value(),
                lambda part, array=array, dtype=leaf.dtype: array[part].astype(dtype),
            )
            placed.append((path, leaf.replace(value)))
    return nnx.from_flat_state(placed)


def _read(path: Path) -> dict[str, Tensor]:
    if not _linked(path).is_file():
        raise _absent(path)
    return read_safetensors(path)


def student_of(file: Path, metadata: Mapping[str, str]) -> Path | None:
    """Return the LoRA next to a denoiser's file that makes it the wanted causal student, or None.

    `metadata` is the wanted student's. Raises `InputError` unless the file itself or the LoRA makes
    the wanted chunks.
    """
    wanted, student = metadata.get(CHUNKS), _linked(_linked(file).with_name(STUDENT))
    if wanted is None or read_metadata(file).get(CHUNKS) == wanted or not student.is_file():
        check_chunks(file, wanted)
        return None
    check_chunks(file, None)  # the base makes clips at once
    check_chunks(student, wanted)
    return student


def check_chunks(file: Path, wanted: str | None) -> None:
    """Raise `InputError` unless a file's denoiser makes these chunks; None: clips at once."""
    chunks = read_metadata(_linked(file)).get(CHUNKS)
    if chunks == wanted:
        return
    has, needs = (
        "a denoiser of whole clips"
        if sizes is None
        else f"a causal student with chunks of {quote(sizes)} latent frames"
        for sizes in (chunks, wanted)
    )
    raise InputError(
        f"{quote_path(file)} is {has}; the config needs {needs}. Give weights of this config, or "
        "the config of these weights. (--weights, --config)"
    )


def check_folder(folder: Path, config: str) -> None:
    """Raise `InputError` if a folder has no denoiser of ours, with the command that converts it."""
    if not _linked(file := folder / "dit.safetensors").is_file():
        raise _absent(file, config)


def _absent(path: Path, config: str = "CONFIG") -> InputError:
    """Return the error of a weights file that is missing, with what its folder has instead."""
    folder = path.parent
    if (folder / "weights" / path.name).is_file():
        return InputError(
            f"{quote_path(folder)} is a run: its weights are in {quote_path(folder / 'weights')}. "
            "(--weights)"
        )
    files = [folder, *sorted(folder.glob("[!.]*")), *sorted(folder.glob("[!.]*/*"))]
    theirs = next((f for f in files if f.is_file() and _is_foreign(f)), None)
    if theirs is None:
        return InputError(
            f"No weights file at {path}. (--weights must name the folder that contains it.)"
        )
    return InputError(
        f"{quote_path(folder)} is a checkpoint of another project, by {quote_path(theirs.name)}. "
        f"Convert it, and give the new folder: egosim convert weights {quote_path(folder)} "
        f"--config {config} --out weights/{config} (--weights)"
    )


def _is_foreign(path: Path) -> bool:
    """Return True for a file of weights in the format of another project."""
    if path.suffix != ".safetensors":
        return path.suffix in SUFFIXES
    try:
        return read_metadata(path).get("format") != OURS
    except InputError:
        return False
