"""Releases of weights on a model hub, pinned to a commit and to the SHA-256 of every file.

A branch on a hub may move, so the first fetch of a release records its commit and hashes, and later
fetches must match them. huggingface_hub downloads the files and resumes interrupted downloads.
"""

from __future__ import annotations

import errno
import fnmatch
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from egosim_jax.io.atomic import PART, lock_folder
from egosim_jax.io.bounded import listing, quote, quote_text, read_json
from egosim_jax.io.digest import sha256
from egosim_jax.io.private import cache_folder
from egosim_jax.io.run import write_json
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError

RECORD = "release.json"
"""File name of the record in a folder of fetched weights."""
DOWNLOADS = ".download"
"""Subfolder of a weights folder that holds downloaded files until they are converted."""
_SAFE = r"(?!\.)[A-Za-z0-9._-]+(?:/(?!\.)[A-Za-z0-9._-]+)*"
_COMMIT, _SHA256 = r"[0-9a-f]{40}", r"[0-9a-f]{64}"


@dataclass(frozen=True, kw_only=True)
class Release:
    """Published weights: their repository on the hub, and their config."""

    name: str
    """Name in `egosim models`."""
    about: str
    config: str
    """Name of the config for their conversion."""
    repository: str
    """Repository on the hub, `OWNER/NAME`."""
    revision: str | None
    """Commit to fetch; if None, the first fetch records it."""
    widen: Literal["copy", "polarity"] | None
    """Method that adds input channels in the conversion (`egosim convert weights --widen`)."""
    files: Mapping[str, str | None]
    """SHA-256 by path or path pattern; if None, the first fetch records it."""

    def pins(self, path: str) -> list[str | None]:
        """Return the hashes of the entries of `files` that match a path."""
        return [pin for pattern, pin in self.files.items() if fnmatch.fnmatchcase(path, pattern)]


def fetched_folder(name: str) -> Path:
    """Return the folder for a release's converted weights, which may not exist yet."""
    return cache_folder() / "weights" / name


def is_fetched(folder: Path) -> bool:
    """Return True if a folder has all weights of a release: the record is written last."""
    return (folder / RECORD).is_file()


def check_fetched(release: Release, folder: Path) -> None:
    """Raise `InputError` if the record in a folder names another release."""
    if differences := _differences(release, _read_record(folder / RECORD)):
        raise InputError(
            f"{folder} holds weights of another release than {release.name}: "
            f"{listing(differences)}. Choose another folder, or remove this one. (--out)"
        )


def record_path(name: str) -> Path:
    """Return the path of the record of a release's first fetch."""
    return cache_folder() / "releases" / f"{name}.json"


def list_files(release: Release) -> tuple[Release, dict[str, int]]:
    """List a release's files on the hub; return the release pinned to them, and sizes in bytes.

    The commit is the pinned or recorded one, else the newest. `files` of the returned release has a
    path for each file, with its SHA-256 if known. Raises `InputError` if the hub is unreachable, a
    file is missing, or a commit or hash differs from the pinned or recorded one.
    """
    from huggingface_hub import HfApi

    pinned = _with_record(release)
    with _asking(release):
        info = HfApi().model_info(release.repository, revision=pinned.revision, files_metadata=True)
    files, sizes = {}, {}
    for sibling in sorted(info.siblings or (), key=lambda sibling: sibling.rfilename):
        path, size = sibling.rfilename, sibling.size
        if not (pins := pinned.pins(path)):
            continue
        if not re.fullmatch(_SAFE, path) or not isinstance(size, int):
            raise InputError(
                f"{release.repository}: {quote(path)} of {quote(size)} bytes is not a file that "
                "can be downloaded safely."
            )
        files[path] = sibling.lfs.sha256 if sibling.lfs else next(filter(None, pins), None)
        sizes[path] = size
    found = replace(release, revision=info.sha, files=files)
    _check(pinned, found)
    return found, sizes


def download(release: Release, folder: Path) -> Release:
    """Download the missing files of a release from `list_files`; return it with all SHA-256.

    All files are verified, and the returned release is recorded in the cache. A file with another
    hash is removed and raises `InputError`.
    """
    from huggingface_hub import snapshot_download

    paths = [*release.files]
    with _asking(release):
        snapshot_download(
            release.repository, revision=release.revision, allow_patterns=paths, local_dir=folder
        )
        # If the hub fails, snapshot_download accepts an incomplete folder from before.
        for path in paths:
            (folder / path).stat()
    hashes = {path: sha256(folder / path) for path in track(paths, "verify", total=len(paths))}
    for path, pin in release.files.items():
        if pin not in (None, hashes[path]):
            (folder / path).unlink()
    fetched = replace(release, files=hashes)
    _check(release, fetched)
    write_json(record_path(release.name), asdict(fetched))
    return fetched


def read_range(release: Release, path: str, start: int, count: int) -> bytes:
    """Return a part of a file of a release from `list_files`, without a download of the rest."""
    from huggingface_hub import hf_hub_url
    from huggingface_hub.utils import build_hf_headers, hf_raise_for_status, http_stream_backoff

    url = hf_hub_url(release.repository, path, revision=release.revision)
    headers = build_hf_headers() | {"Range": f"bytes={start}-{start + count - 1}"}
    with _asking(release), http_stream_backoff("GET", url, headers=headers) as response:
        hf_raise_for_status(response)
        if response.status_code != 206:
            raise ValueError("its server does not send parts of files")
        return response.read()


def bytes_needed(size: int, folder: Path) -> int:
    """Return the free bytes that the rest of a download and its conversion need."""
    files = [*(folder / DOWNLOADS).rglob("*")]
    if files:  # a fetch was interrupted: the networks in the folder are of it
        files += [*folder.glob("*.safetensors"), *folder.glob(f"*{PART}")]
    return max(2 * size - sum(file.stat().st_size for file in files if file.is_file()), 0)


def remove_download(folder: Path) -> None:
    """Remove the downloaded files of a complete fetch."""
    if (downloads := folder / DOWNLOADS).exists():
        with lock_folder(folder):
            shutil.rmtree(downloads)


def check_space(needed: int, folder: Path) -> None:
    """Raise `InputError` if the disk of a folder has too little free space."""
    free = free_space(folder)
    if free < needed:
        raise InputError(
            f"The disk of {folder} has {free / 1e9:.1f} GB free, and {needed / 1e9:.1f} GB are "
            "needed for the download and the converted weights. Free space or choose another "
            "folder. (--out)"
        )


def free_space(folder: Path) -> int:
    """Return the free bytes on the disk of a folder, which may not exist yet."""
    above = next(f for f in (folder, *folder.absolute().parents) if f.exists())
    return shutil.disk_usage(above).free


def _with_record(release: Release) -> Release:
    """Return a release with the commit and the hashes of its first fetch, if there was one."""
    path = record_path(release.name)
    if not path.is_file():
        return release
    record = _read_record(path)
    if record.repository != release.repository:
        raise InputError(
            f"{path} records a fetch from {quote(record.repository)}; expected "
            f"{release.repository}. Remove it to fetch the new release."
        )
    # Pinned hashes take precedence over recorded ones.
    recorded = {p: pin for p, pin in record.files.items() if {*release.pins(p)} == {None}}
    revision = release.revision or record.revision
    return replace(release, revision=revision, files={**release.files, **recorded})


def _read_record(path: Path) -> Release:
    """Read the record of a fetched release, with its commit and the SHA-256 of each file."""
    record = read_json(path)
    with suppress(TypeError, AttributeError):
        found = Release(**record)
        if re.fullmatch(_COMMIT, found.revision or "") and all(
            re.fullmatch(_SHA256, pin or "") for pin in found.files.values()
        ):
            return found
    raise InputError(f"{path} is not a record of a fetched release. Remove it.")


def _differences(release: Release, found: Release) -> list[str]:
    """List the differences in repository, commit, files and known hashes."""
    differences = []
    if found.repository != release.repository:
        differences.append(f"repository {quote(found.repository)}; expected {release.repository}")
    if not re.fullmatch(release.revision or _COMMIT, found.revision or ""):
        expected = release.revision or "40 hexadecimal digits"
        commit = quote_text(found.revision or "unknown")
        differences.append(f"commit {commit} instead of the expected {expected}")
    for pattern, pin in release.files.items():
        hashes = {p: found.files[p] for p in fnmatch.filter(found.files, pattern)}
        if not hashes:
            differences.append(f"no file {pattern}")
        differences += [
            f"{quote_text(path)} has SHA-256 {quote_text(found_hash)}; expected {quote_text(pin)}"
            for path, found_hash in hashes.items()
            if pin and found_hash and found_hash != pin
        ]
    return differences


def _check(release: Release, found: Release) -> None:
    """Raise `InputError` if the hub's release differs from the expected one."""
    if differences := _differences(release, found):
        raise InputError(
            f"{release.repository} is not {release.name} as expected: {listing(differences)}. Run "
            f"the same command again, or remove {record_path(release.name)} to accept a changed "
            f"release, or download the weights by hand and convert them. ({_by_hand(release)})"
        )


@contextmanager
def _asking(release: Release) -> Iterator[None]:
    """Turn exceptions of the hub's client into `InputError`, except disk errors."""
    try:
        yield
    except Exception as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EACCES):
            raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"{release.repository} cannot be downloaded: {quote_text(reason[0])}. Run the same "
            "command again to continue, or download the weights by hand and convert them. "
            f"({_by_hand(release)})"
        ) from error


def _by_hand(release: Release) -> str:
    widen = f" --widen {release.widen}" if release.widen else ""
    return f"egosim convert weights FOLDER --config {release.config}{widen} --out WEIGHTS"
