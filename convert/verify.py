"""`egosim convert verify`: comparison of converted weights with their checkpoint.

One forward is compared with PyTorch's networks in diffusers and transformers. If a naming has no
independent renaming to their names (`Naming.to_reference`), our own rules rename the tensors. Then
the comparison checks sizes and arithmetic but not names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from egosim_jax.convert.detect import DetectedNetwork, detect
from egosim_jax.convert.plan import network_config, to_jax, to_torch, widening_of
from egosim_jax.convert.quantize import SOURCE, quantized_weights, sources_of
from egosim_jax.convert.tables import Comparison, Reader, Reference
from egosim_jax.convert.widen import Widening, WidenMode
from egosim_jax.convert.writer import Weight, in_rows
from egosim_jax.io.bounded import quote_path, quote_text
from egosim_jax.io.mapped import Tensor, read_metadata, read_safetensors, read_weights_hash
from egosim_jax.io.weights import WeightsError, fill, flat_shapes, hashes, mismatches
from egosim_jax.runtime import command
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.models import NetworkConfig
    from egosim_jax.models.eight_bit import Kind

TOLERANCE = 1e-4
"""Maximum relative L2 error in float32 of two layers, or of a complete autoencoder."""
LIBRARIES = ("torch", "diffusers", "transformers")
"""Libraries of a comparison; the extra `test` installs them."""


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Compare a weights folder with the checkpoint that it was converted from.

    Every value must equal the source's bit for bit, after the change of layout and dtype, and match
    its checksum. With torch, diffusers and transformers installed, it also compares one forward of
    each network.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """File in .safetensors or .pth format, or folder of them; of weights in 8 bits, their source.
    """
    weights: Annotated[Path, tyro.conf.Positional]
    """Weights folder converted from it."""
    config: str
    """Name of the model."""
    prefix: str | None = None
    """Value of --prefix in the conversion."""
    widen: WidenMode | None = None
    """Value of --widen in the conversion."""

    def run(self) -> int:
        """Compare the weights; return 1 if any differs."""
        from egosim_jax import configs

        config = configs.get(self.config)
        if sources := sources_of(self.source, self.weights):
            return self._verify_8_bits(sources)
        has_pytorch = all(map(find_spec, LIBRARIES))
        wrong = []
        folder = detect(self.source, config).only(self.prefix)
        files = {f.network: self.weights / f"{f.network}.safetensors" for f in folder.found}
        if not any(file.exists() for file in files.values()):
            raise InputError(
                f"{quote_path(self.weights)} has none of the networks of "
                f"{quote_path(self.source)}, {', '.join(files) or 'which has none'}."
            )
        for found in map(folder.network, files):
            file = files[found.network]
            if not file.exists():
                print(f"{found.network}: not converted")
                continue
            widening = widening_of(config, found.network, self.widen)
            # `_same` casts each piece to the dtype in the file: any dtype does here.
            weights = to_jax(found, config, dtype="float32", widening=widening)
            tensors = read_safetensors(file)
            differ, damaged = _compare(found.network, weights, tensors, file)
            wrong += damaged + differ
            reference = found.table.reference
            if reference is None:
                print(f"{found.network}: no forward compared: its table has no reference")
            elif has_pytorch and not damaged:
                network = network_config(config, found.network)
                error = _relative_error(found, reference, tensors, network, widening)
                print(f"{found.network}: forward differs from PyTorch's by {error:.1e}")
                if not error <= TOLERANCE:
                    wrong.append(f"{found.network}: forward differs by more than rounding")
        if not has_pytorch:
            print(f"no forward compared: that needs {', '.join(LIBRARIES)}")
        return _report(wrong)

    def _verify_8_bits(self, sources: Mapping[str, tuple[Path, Kind]]) -> int:
        """Quantize the sources again, and compare; return 1 if any weight differs."""
        wrong = []
        for name, (source, kind) in sources.items():
            file = self.weights / source.name
            if (origin := read_metadata(file).get(SOURCE)) not in (None, read_weights_hash(source)):
                wrong.append(f"{name}: made of weights with the hash {quote_text(origin[:12])}")
            weights = quantized_weights(source, kind)
            differ, damaged = _compare(name, weights, read_safetensors(file), file)
            wrong += damaged + differ
        for name, digest in hashes(self.source).items():
            file = self.weights / f"{name}.safetensors"
            if name in sources or not file.exists():
                continue
            tensors = read_safetensors(file)
            damaged = [path for path, tensor in tensors.items() if not tensor.intact]
            wrong += [f"{name}: {path} does not match its checksum" for path in damaged]
            if read_weights_hash(file) != digest:
                wrong.append(f"{name}: is not the network of {quote_path(self.source)}")
            print(f"{name}: not in 8 bits")
        return _report(wrong)


def _report(wrong: Sequence[str]) -> int:
    """Print the differences; return the exit code."""
    print(printable("\n".join(wrong)), end="\n" if wrong else "")
    return command.ExitCode.FAILED if wrong else command.ExitCode.DONE


def _compare(
    network: str, weights: Sequence[Weight], tensors: Mapping[str, Tensor], file: Path
) -> tuple[list[str], list[str]]:
    """Return lines about the weights of a file that differ, and about those that are damaged."""
    if problems := mismatches(tensors, {w.name: w.shape for w in weights}):
        raise WeightsError(problems, source=str(file))
    damaged = [name for name, tensor in tensors.items() if not tensor.intact]
    if not any(tensor.checksum for tensor in tensors.values()):
        print(f"{network}: no checksums; converting again adds them")
    differ = [
        weight.name
        for weight in track(weights, f"comparing {network}", total=len(weights))
        if weight.name not in damaged and not _same(weight, tensors[weight.name])
    ]
    equal = len(weights) - len(differ) - len(damaged)
    print(f"{network}: {equal} of {len(weights)} weights equal")
    return (
        [f"{network}: {name} differs" for name in differ],
        [f"{network}: {name} does not match its checksum" for name in damaged],
    )


def _same(weight: Weight, tensor: Tensor) -> bool:
    """Return True if the tensor equals the pieces, cast to its dtype, bit for bit."""
    parts = tensor.array().reshape(len(weight.pieces), -1)
    return all(
        np.array_equal(
            in_rows(piece().astype(tensor.dtype, copy=False)).reshape(-1).view(np.uint8),
            part.view(np.uint8),
        )
        for part, piece in zip(parts, weight.pieces, strict=True)
    )


def _relative_error(
    found: DetectedNetwork,
    reference: Reference,
    converted: Mapping[str, Tensor],
    config: NetworkConfig,
    widening: Widening | None,
) -> float:
    """Return the relative L2 error of converted weights' output from a checkpoint's, in float32.

    It is absolute if the checkpoint's output is 0, as before the first update of a zero head.
    Both networks get the same random input. If the weights have one dtype, the
    checkpoint is first cast to it.
    """
    import jax

    from egosim_jax.models import abstract

    short = reference.shorten(config)
    network = abstract(short)
    shapes = flat_shapes(network)
    fill(network, {path: _cut(converted[path].array(), s) for path, s in shapes.items()})
    dtypes = {tensor.dtype for tensor in converted.values()}
    readers = _readers(found, config, converted, reference)
    comparison = Comparison(
        network=network,
        config=short,
        load=partial(_load, readers, dtypes.pop() if len(dtypes) == 1 else None),
        widening=widening,
        make=reference.make,
    )
    with jax.default_matmul_precision("highest"):
        have, want = reference.outputs(comparison)
    size, error = np.linalg.norm(want), np.linalg.norm(have - want)
    return float(error / size) if size else float(error)


def _load(
    readers: Mapping[str, Reader],
    cast: np.dtype | None,
    module: Any,
    *,
    prefix: str = "",
    unused: str | None = None,
) -> Any:
    """Fill a PyTorch module; its parameter names have a `prefix` that the checkpoint lacks.

    Parameters with `unused` in their name may be missing. Raises `InputError` listing all other
    missing parameters.
    """
    import torch

    state, missing = {}, []
    for name, parameter in module.named_parameters():
        read = readers.get(name.removeprefix(prefix))
        if read is not None:
            values = _cut(read(), tuple(parameter.shape), cast=cast)
            state[name] = torch.from_numpy(values)
        elif unused is None or unused not in name:
            missing.append(name)
    if missing:
        raise InputError(f"The checkpoint has no {', '.join(missing)}, which PyTorch needs.")
    module.load_state_dict(state, strict=False)
    return module.eval()


def _cut(array: np.ndarray, shape: tuple[int, ...], cast: np.dtype | None = None) -> np.ndarray:
    """Return the leading part of an array, of the given shape, in float32."""
    if array.ndim != len(shape) or any(n < m for n, m in zip(array.shape, shape, strict=True)):
        raise InputError(f"The weights have {array.shape} where {shape} is needed.")
    leading = array[tuple(map(slice, shape))]
    return np.array(leading if cast is None else leading.astype(cast), np.float32)


def _readers(
    found: DetectedNetwork,
    config: NetworkConfig,
    converted: Mapping[str, Tensor],
    reference: Reference,
) -> Mapping[str, Reader]:
    """Return a reader of each tensor of the checkpoint by its name in the reference."""
    readers = {name: tensor.array for name, tensor in found.tensors.items()}
    if found.naming == reference.library:
        return readers
    rename = found.table.namings[found.naming].to_reference
    if rename is not None and (renamed := rename(readers, config)) is not None:
        return renamed
    return {
        weight.name: weight.pieces[0]
        for weight in to_torch(converted, config, reference.library, source=found.network)
    }
