"""Comparison of one forward of a converted network with PyTorch's on the original checkpoint.

The PyTorch networks are from diffusers and transformers. If a naming has no independent renaming to
their names (`Naming.to_reference`), our own rules rename the tensors. Then the comparison checks
sizes and arithmetic but not names.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egosim_jax.convert.detect import DetectedNetwork
from egosim_jax.convert.plan import to_torch
from egosim_jax.convert.tables import Comparison, Reader, Reference
from egosim_jax.convert.widen import Widening
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models import abstract
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.models import NetworkConfig

TOLERANCE = 1e-4
"""Maximum relative L2 error in float32 of two layers, or of a complete autoencoder."""
MODULES = ("torch", "diffusers", "transformers")
"""Libraries of a comparison; the extra `test` installs them."""


def possible() -> bool:
    """Return True if all libraries of a comparison are installed."""
    return all(find_spec(name) for name in MODULES)


def relative_error(
    found: DetectedNetwork, file: Path, config: NetworkConfig, *, widening: Widening | None = None
) -> float:
    """Return the relative L2 error of a converted file's output from its checkpoint's, in float32.

    It is absolute if the checkpoint's output is 0, as before the first update of a zero head.
    Both networks get the same random input. The checkpoint is first cast to the file's dtype.
    """
    import jax

    reference = found.table.reference
    if reference is None:
        raise InputError(f"The network {found.network} has no reference implementation.")
    converted = read_safetensors(file)
    short = reference.shorten(config)
    network = abstract(short)
    shapes = flat_shapes(network)
    fill(network, {path: _cut(converted[path].array(), s) for path, s in shapes.items()})
    dtypes = {tensor.dtype for tensor in converted.values()}
    checkpoint = Checkpoint(
        _readers(found, config, converted, reference),
        cast=dtypes.pop() if len(dtypes) == 1 else None,
    )
    comparison = Comparison(
        network=network,
        config=short,
        load=checkpoint.load,
        widening=widening,
        make=reference.make,
    )
    with jax.default_matmul_precision("highest"):
        have, want = reference.outputs(comparison)
    size, error = np.linalg.norm(want), np.linalg.norm(have - want)
    return float(error / size) if size else float(error)


class Checkpoint:
    """Tensors of a checkpoint in the names of diffusers or transformers."""

    def __init__(self, readers: Mapping[str, Reader], cast: np.dtype | None):
        self.readers, self.cast = readers, cast

    def load(self, module: Any, *, prefix: str = "", unused: str | None = None) -> Any:
        """Fill a PyTorch module; its parameter names have a `prefix` that the checkpoint lacks.

        Parameters with `unused` in their name may be missing. Raises `InputError` listing all other
        missing parameters.
        """
        import torch

        state, missing = {}, []
        for name, parameter in module.named_parameters():
            read = self.readers.get(name.removeprefix(prefix))
            if read is not None:
                values = _cut(read(), tuple(parameter.shape), cast=self.cast)
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
        raise InputError(f"The checkpoint has {array.shape} where PyTorch needs {shape}.")
    part = array[tuple(map(slice, shape))]
    return np.array(part if cast is None else part.astype(cast), np.float32)


def _readers(
    found: DetectedNetwork,
    config: NetworkConfig,
    converted: Mapping[str, Tensor],
    reference: Reference,
) -> Mapping[str, Reader]:
    """Return a reader of each tensor of the checkpoint by its name in the reference."""
    readers = {name: tensor.array for name, tensor in found.tensors.items()}
    if found.naming == reference.naming:
        return readers
    rename = found.table.namings[found.naming].to_reference
    if rename is not None and (renamed := rename(readers, config)) is not None:
        return renamed
    return {
        weight.name: weight.pieces[0]
        for weight in to_torch(converted, config, reference.naming, source=found.network)
    }
