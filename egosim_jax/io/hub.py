"""Releases of weights on a model hub: pinned, resumed, and verified by their SHA-256.

A branch of a hub may move, so the first fetch of a release records the commit and the hash of every
file. From then on the record is what a fetch must match, as are the hashes of the release itself.
"""

from __future__ import annotations

import errno
import fnmatch
import hashlib
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from egosim_jax.io.atomic import LOG, PART, lock_folder
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted.bounded import open_regular, quote, quote_text, read_json
from egosim_jax.io.untrusted.private import cache_folder
from egosim_jax.runtime.progress import track_bytes
from egosim_jax.types import InputError

T = TypeVar("T")

RECORD = "release.json"
"""Name of the record in a folder of fetched weights."""
DOWNLOADS = ".download"
"""Name of the folder of downloaded files in a folder of weights, until they are converted."""
BLOCK = 1 << 24
"""Bytes hashed at a time."""
_SAFE = re.compile(r"(?!\.)[A-Za-z0-9._-]+(?:/(?!\.)[A-Za-z0-9._-]+)*")
_COMMIT = re.compile(r"[0-9a-f]{40}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, kw_only=True)
class Release:
    """Published weights: their repository on the hub and the config that they are for."""

    name: str
    """Name in `egosim models`."""
    about: str
    """Description of the weights in one line."""
    config: str
    """Name of the config that they are converted for."""
    repository: str
    """Repository on the hub, `OWNER/NAME`."""
    revision: str | None
    """Commit to fetch; None if unknown, then the first fetch records it."""
    widen: Literal["copy", "polarity"] | None
    """Widening of the input channels in the conversion (`egosim convert weights --widen`)."""
    files: Mapping[str, str | None]
    """Paths, or patterns of them, and their SHA-256; None if unknown, as for the revision."""


@dataclass(frozen=True, kw_only=True)
class RemoteFile:
    """File of a release on the hub."""

    path: str
    """Path in the repository."""
    bytes: int
    """Size of the file in bytes."""
    sha256: str | None
    """Hash that its content must have; None if nobody published one."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """Files of a release at one commit."""

    revision: str
    """Commit, 40 hexadecimal digits."""
    files: tuple[RemoteFile, ...]
    """Files to download, in the order of their paths."""

    @property
    def bytes(self) -> int:
        """Size of all files, in bytes."""
        return sum(file.bytes for file in self.files)


def fetched_folder(name: str) -> Path:
    """Return the folder of a release's converted weights, there or not yet."""
    return cache_folder() / "weights" / name


def is_fetched(folder: Path) -> bool:
    """Return whether a folder has all weights of a release: the record is written last."""
    return (folder / RECORD).is_file()


def check_fetched(release: Release, folder: Path) -> None:
    """Raise `InputError` if the weights in a folder are not those of a release, by its record."""
    record = _read_record(folder / RECORD)
    problems = []
    if record["repository"] != release.repository:
        problems.append(f"repository {quote(record['repository'])}")
    if release.revision not in (None, record["revision"]):
        problems.append(f"commit {record['revision']}")
    for pattern, pinned in release.files.items():
        files = fnmatch.filter(record["files"], pattern)
        hashes = {record["files"][file]["sha256"] for file in files}
        if not hashes:
            problems.append(f"no file {pattern}")
        elif pinned not in (None, *hashes) or (pinned and len(hashes) > 1):
            problems.append(f"{pattern} with another SHA-256")
    if problems:
        at = f" at commit {release.revision}" if release.revision else ""
        raise InputError(
            f"{folder} holds weights of another release: {'; '.join(problems)}; expected "
            f"{release.repository}{at} for {release.name}. Choose another folder, or remove this "
            "one. (--out)"
        )


def record_path(name: str) -> Path:
    """Return the path of the record of a release's first fetch."""
    return cache_folder() / "releases" / f"{name}.json"


def list_files(release: Release) -> Listing:
    """Ask the hub for the files of a release, at the pinned or recorded commit if there is one.

    Raises `InputError` if the hub cannot be reached, a file is missing, or a hash is not the
    recorded one.
    """
    from huggingface_hub import HfApi

    path = record_path(release.name)
    record = _read_record(path) if path.is_file() else {}
    if record and record["repository"] != release.repository:
        raise InputError(
            f"{path} records a fetch from {quote(record['repository'])}; expected "
            f"{release.repository}. Remove it to fetch the new release."
        )
    revision = release.revision or record.get("revision")
    info = _ask(
        release,
        lambda: HfApi().model_info(release.repository, revision=revision, files_metadata=True),
    )
    if not _COMMIT.fullmatch(info.sha or ""):
        raise InputError(f"The hub names no commit of {release.repository}: {quote(info.sha)}.")
    if revision not in (None, info.sha):
        raise InputError(
            f"The hub gave commit {info.sha} of {release.repository}; expected {revision}. Run the "
            "same command again, or download the weights by hand and convert them. "
            f"({_by_hand(release)})"
        )
    files = []
    for pattern, pinned in release.files.items():
        found = [s for s in info.siblings or () if fnmatch.fnmatchcase(s.rfilename, pattern)]
        if not found:
            raise InputError(
                f"{release.repository} has no file {pattern} at commit {info.sha}. Download the "
                f"weights by hand and convert them. ({_by_hand(release)})"
            )
        for sibling in found:
            if not _SAFE.fullmatch(sibling.rfilename) or not isinstance(sibling.size, int):
                raise InputError(
                    f"{release.repository}: {quote(sibling.rfilename)} of {quote(sibling.size)} "
                    "bytes is not a file that can be downloaded safely."
                )
            published = sibling.lfs.sha256 if sibling.lfs else None
            recorded = record.get("files", {}).get(sibling.rfilename, {}).get("sha256")
            expected = pinned or recorded or published
            if published and published != expected:
                raise InputError(_mismatch(release, sibling.rfilename, published, str(expected)))
            files.append(
                RemoteFile(path=sibling.rfilename, bytes=sibling.size, sha256=expected),
            )
    return Listing(revision=str(info.sha), files=tuple(sorted(files, key=lambda file: file.path)))


def download(release: Release, listing: Listing, folder: Path) -> dict[str, str]:
    """Download the files that a folder lacks, continuing partial ones; return their SHA-256.

    The commit and the hashes are recorded, in the cache, when all files are verified. A file with
    another hash is removed and raises `InputError`.
    """
    from huggingface_hub import hf_hub_download

    for file in listing.files:
        _ask(
            release,
            lambda path=file.path: hf_hub_download(
                release.repository, path, revision=listing.revision, local_dir=folder
            ),
        )
    hashes: dict[str, str] = {}

    def blocks() -> Iterator[int]:
        for file in listing.files:
            digest = hashlib.sha256()
            with open_regular(folder / file.path) as opened:
                while block := opened.read(BLOCK):
                    digest.update(block)
                    yield len(block)
            hashes[file.path] = digest.hexdigest()

    for _ in track_bytes(blocks(), "verify", total=listing.bytes):
        pass
    for file in listing.files:
        if file.sha256 is not None and hashes[file.path] != file.sha256:
            (folder / file.path).unlink()
            raise InputError(_mismatch(release, file.path, hashes[file.path], file.sha256))
    write_json(record_path(release.name), as_record(release, listing, hashes))
    return hashes


def as_record(release: Release, listing: Listing, hashes: Mapping[str, str]) -> dict[str, Any]:
    """Return the JSON record of a fetched release."""
    files = {f.path: {"bytes": f.bytes, "sha256": hashes[f.path]} for f in listing.files}
    return {"repository": release.repository, "revision": listing.revision, "files": files}


def bytes_needed(listing: Listing, folder: Path) -> int:
    """Return the bytes of free disk space that the rest of a download and its conversion need."""
    files = [file for file in (folder / DOWNLOADS).rglob("*") if file.is_file()]
    for log in folder.glob(f"*{LOG}"):
        target = log.with_name(log.name.removesuffix(LOG))
        part = target.with_name(target.name + PART)
        files += [file for file in (part, target) if file.is_file()][:1]
    found = [file.stat() for file in files]
    # A network that is being written has its full size from the start; its blocks come later.
    there = sum(min(stat.st_size, 512 * stat.st_blocks) for stat in found)
    return max(2 * listing.bytes - there, 0)


def remove_leftovers(folder: Path, *, keep_download: bool) -> None:
    """Remove what a complete fetch no longer needs: logs of the conversion and the download."""
    downloads = folder / DOWNLOADS
    if not any(folder.glob(f"*{LOG}")) and (keep_download or not downloads.exists()):
        return
    with lock_folder(folder):
        for log in folder.glob(f"*{LOG}"):
            log.unlink()
        if downloads.exists() and not keep_download:
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
    """Return the free bytes on the disk of a folder, which need not exist yet."""
    above = next(f for f in (folder, *folder.absolute().parents) if f.exists())
    return shutil.disk_usage(above).free


def _read_record(path: Path) -> dict[str, Any]:
    record = read_json(path)
    files = record.get("files") if isinstance(record, dict) else None
    valid = (
        isinstance(files, dict)
        and isinstance(record.get("repository"), str)
        and _COMMIT.fullmatch(str(record.get("revision")))
        and all(
            isinstance(f, dict) and _SHA256.fullmatch(str(f.get("sha256"))) for f in files.values()
        )
    )
    if not valid:
        raise InputError(f"{path} is not a record of a fetched release. Remove it.")
    return record


def _ask(release: Release, call: Callable[[], T]) -> T:
    """Call the hub's client; what it raises becomes an `InputError`, unless it is of the disk."""
    try:
        return call()
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


def _mismatch(release: Release, path: str, have: str, expected: str) -> str:
    return (
        f"{release.repository}: {path} has SHA-256 {quote_text(have)}; expected "
        f"{quote_text(expected)}. The download was damaged or the release has changed: run "
        f"the same command again, or remove {record_path(release.name)} to accept the new files."
    )
