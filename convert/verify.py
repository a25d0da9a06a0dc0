"""`egosim convert verify`: comparison of converted weights with their checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax.convert.detect import detect
from egosim_jax.convert.plan import network_config, to_jax, widening_of
from egosim_jax.convert.widen import WidenMode
from egosim_jax.convert.writer import Weight, in_rows
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.io.weights import WeightsError, mismatches
from egosim_jax.runtime import command
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Compare a weights folder with the checkpoint that it was converted from.

    Every value must equal the source's bit for bit, after the change of layout and dtype, and match
    its checksum. With torch, diffusers and transformers installed, it also compares one forward of
    each network.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """File in .safetensors or .pth format, or folder of them."""
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
        from egosim_jax.convert import reference

        config = configs.get(self.config)
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
            if problems := mismatches(tensors, {w.name: w.shape for w in weights}):
                raise WeightsError(problems, source=str(file))
            damaged = [name for name, tensor in tensors.items() if not tensor.intact]
            wrong += [f"{found.network}: {name} does not match its checksum" for name in damaged]
            if not any(tensor.checksum for tensor in tensors.values()):
                print(f"{found.network}: no checksums; converting again adds them")
            differ = [
                weight.name
                for weight in track(weights, f"comparing {found.network}", total=len(weights))
                if weight.name not in damaged and not _same(weight, tensors[weight.name])
            ]
            equal = len(weights) - len(differ) - len(damaged)
            print(f"{found.network}: {equal} of {len(weights)} weights equal")
            wrong += [f"{found.network}: {name} differs" for name in differ]
            if found.table.reference is None:
                print(f"{found.network}: no forward compared: its table has no reference")
            elif reference.possible() and not damaged:
                network = network_config(config, found.network)
                error = reference.relative_error(found, file, network, widening=widening)
                print(f"{found.network}: forward differs from PyTorch's by {error:.1e}")
                if not error <= reference.TOLERANCE:
                    wrong.append(f"{found.network}: forward differs by more than rounding")
        if not reference.possible():
            print(f"no forward compared: that needs {', '.join(reference.MODULES)}")
        print(printable("\n".join(wrong)), end="\n" if wrong else "")
        return command.ExitCode.FAILED if wrong else command.ExitCode.DONE


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
