"""Checkpoints of networks: local folders in the layout of `save_pretrained`.

Only safetensors and JSON are read. Nothing is downloaded, and no code of a checkpoint runs. The
error for another network's folder names the network found and the network needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.io.digest import fingerprint, sha256
from egosim_jax.perception.networks.worker import worker_of
from egosim_jax.types import Counted, InputError

DType = Literal["float32", "bfloat16", "float16"]
CONFIG, WEIGHTS, INDEX = "config.json", "model.safetensors", "model.safetensors.index.json"
NOT_CONTENT = ("folder", "device", "timeout_s")
"""Fields outside the fingerprint: they change neither a network nor its results."""


@dataclass(frozen=True)
class Network(Counted):
    """Network in a worker process, loaded from a local folder on first use."""

    needs: ClassVar[str]
    """Name of the network and of its checkpoint, for messages."""
    model_types: ClassVar[tuple[str, ...]]
    """Accepted values of `model_type` in config.json."""
    files: ClassVar[tuple[str, ...]] = ()
    """Further required files of a checkpoint."""
    packages: ClassVar[tuple[str, ...]] = ("torch", "transformers")
    """Packages that the worker imports."""
    install: ClassVar[str] = "pip install 'egosim-jax[networks]'"
    """Command that installs the packages."""

    folder: Path
    """Folder of the checkpoint, with config.json and safetensors."""
    _: KW_ONLY
    device: str = "auto"
    """Device of the worker: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: DType = "float32"
    """Floating-point type of the network."""
    timeout_s: float = 1800.0
    """Timeout for one clip in seconds, including the loading of the network."""

    def __post_init__(self) -> None:
        """Check that the folder is a checkpoint of this network."""
        super().__post_init__()
        if self.timeout_s <= 0:
            raise InputError(f"timeout_s must be positive, not {self.timeout_s}. (--timeout-s)")
        self.check_config(self._read_config())
        weights_of(self.folder)
        missing = [name for name in self.files if not (self.folder / name).is_file()]
        if missing:
            raise InputError(
                f"{quote_path(self.folder)} has no {', '.join(missing)}: {self.needs} needs the "
                "whole folder of its checkpoint. Download all of its files."
            )

    def check_config(self, config: Mapping[str, Any]) -> None:
        """Raise `InputError` if config.json belongs to another network."""
        model_type = config.get("model_type")
        if model_type not in self.model_types:
            raise InputError(
                f"{quote_path(self.folder)} is a checkpoint of model_type {quote(model_type)}: "
                f"{self.needs} needs {' or '.join(self.model_types)}. Give the folder of such a "
                "checkpoint."
            )

    def check_installed(self) -> None:
        """Raise `InputError` with the missing packages of the worker."""
        missing = [name for name in self.packages if find_spec(name) is None]
        if missing:
            raise InputError(
                f"{self.needs} cannot run: {' and '.join(missing)} must be installed. "
                f"{self.install}"
            )

    def fingerprint(self) -> str:
        """Return the hash of the network's files and parameters, without the folder's path."""
        options = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in NOT_CONTENT}
        return fingerprint((type(self).__name__, options, file_hashes(self.folder)))

    def ask(
        self, arrays: Mapping[str, np.ndarray], **options: Any
    ) -> tuple[dict[str, np.ndarray], Any]:
        """Return the arrays and the JSON value of the worker's reply."""
        self.check_installed()
        settings = {
            "folder": str(self.folder.absolute()),
            "device": self.device,
            "dtype": self.dtype,
        }
        worker = worker_of(type(self).__module__, settings)
        return worker(arrays, options, timeout_s=self.timeout_s)

    def _read_config(self) -> dict[str, Any]:
        path = self.folder / CONFIG
        if not path.is_file():
            raise InputError(
                f"{quote_path(self.folder)} has no {CONFIG}: {self.needs} needs the folder of its "
                "checkpoint, as downloaded. Check the path."
            )
        config = read_json(path)
        if not isinstance(config, dict):
            raise InputError(f"{quote_path(path)} must hold an object, not {quote(config)}.")
        return config


def weights_of(folder: Path) -> tuple[Path, ...]:
    """Return the safetensors files of a checkpoint. Raises `InputError` if one is missing."""
    if (index := folder / INDEX).is_file():
        content = read_json(index)
        shards = content.get("weight_map") if isinstance(content, dict) else None
        if not isinstance(shards, dict) or not all(isinstance(v, str) for v in shards.values()):
            raise InputError(f"{quote_path(index)} has no weight_map of file names.")
        names = sorted(set(shards.values()))
        if any(Path(name).name != name for name in names):
            raise InputError(f"{quote_path(index)} names a file outside its folder.")
    else:
        names = [WEIGHTS]
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        others = sorted(path.name for path in folder.glob("*.bin"))
        hint = f" {others[0]} is a pickle, which is not read." if others else ""
        raise InputError(
            f"{quote_path(folder)} has no {missing[0]}: weights must be in safetensors.{hint} "
            "Download all files of the checkpoint."
        )
    return tuple(folder / name for name in names)


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of a checkpoint's weights, JSON and text files, by name."""
    return {path.name: _hash(path, path.stat().st_mtime_ns) for path in _files(folder)}


def _files(folder: Path) -> Iterator[Path]:
    yield from weights_of(folder)
    yield from sorted(p for e in ("json", "txt", "jinja") for p in folder.glob(f"*.{e}"))


@lru_cache(maxsize=256)
def _hash(path: Path, _modified: int) -> str:
    return sha256(path)


def load_network(network: Any, folder: str, device: str, dtype: str) -> Any:
    """Load a class of transformers on a device, in a worker.

    Raises `InputError` if weights are missing, or if this machine lacks the device.
    """
    device = check_device(device)
    model, report = network.from_pretrained(
        folder,
        local_files_only=True,
        use_safetensors=True,
        dtype=dtype,
        output_loading_info=True,
    )
    wrong: Sequence[str] = sorted(map(str, [*report["missing_keys"], *report["mismatched_keys"]]))
    if wrong:
        raise InputError(
            f"{quote_path(Path(folder))} lacks {len(wrong)} weights of {network.__name__}, such as "
            f"{quote(wrong[0])}, or has them in another shape. Download the checkpoint again."
        )
    return model.eval().to(device)


def check_device(device: str) -> str:
    """Return the name of a torch device. Raises `InputError` if this machine lacks it."""
    import torch

    if device == "auto":
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    kind, _, number = device.partition(":")
    count = {"cpu": 1, "cuda": torch.cuda.device_count()}.get(kind, 0)
    if not (number or "0").isdecimal() or int(number or 0) >= count:
        raise InputError(
            f"There is no device {quote(device)}: torch {torch.__version__} finds the CPU and "
            f"{torch.cuda.device_count()} GPUs. Use auto, cpu or cuda:N. (--device)"
        )
    return device
