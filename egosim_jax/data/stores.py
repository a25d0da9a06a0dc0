"""Shards on object stores: addresses such as `s3://BUCKET/FOLDER`, copied once to this machine.

A training reads every record in every epoch, in random order, so one complete copy costs less than
reads of single records, and the store is asked once. The copy has the layout of the store, and
readers treat it as any other folder of shards. It is checked like any downloaded folder:

    manifest    of limited size, validated and compared with its own hash
    shards      size and SHA-256 are compared with the manifest
    mixtures    their parts must be in the same bucket
    files       renamed to their names when complete; the manifest is written last

The next start asks for the manifest again and copies what changed or is missing. fsspec's packages
copy, repeat failed transfers and find credentials and endpoints: environment, files, instance.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from egosim_jax.data.manifest import MANIFEST, Manifest, ShardInfo, file_problems, parse_manifest
from egosim_jax.data.mixing import MIXTURE, read_mixture
from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.bounded import MAX_JSON_BYTES, parse_json, quote, quote_text, read_bytes
from egosim_jax.io.digest import sha256
from egosim_jax.io.private import cache_folder
from egosim_jax.runtime.command import ExitCode, ProcessExit
from egosim_jax.runtime.progress import track_bytes
from egosim_jax.types import InputError

_TRANSFERS = 8
_ADDRESS = re.compile(r"([a-z][a-z0-9]*)://([A-Za-z0-9][A-Za-z0-9._-]*)((?:/[^/?#*\[\]\\]+)*)/*")


def local_shards(
    shards: str | Path, *, cache: Path | None = None, limit: int = 1000 * 10**9
) -> Path:
    """Return the folder of shards: the given one, or the copy in `cache` of those at an address.

    Missing shards are copied there. `cache` is by default in the user's cache folder, and holds at
    most `limit` bytes. One process at a time copies to it; the others wait, and find the copy.
    Raises `InputError` if the store refuses, or holds no valid shards or more than fits, and
    `ProcessExit` if a transfer fails.
    """
    if isinstance(shards, Path) or "://" not in shards:
        return Path(shards)
    match = _ADDRESS.fullmatch(shards)
    parts = [] if match is None else match[3].split("/")[1:]
    if match is None or {".", ".."} & {*parts} or not shards.isprintable():
        raise InputError(
            f"{quote(shards)} is not an address of shards: give a folder, s3://BUCKET/FOLDER or "
            "gs://BUCKET/FOLDER. (--latents, --validation)"
        )
    root = cache or cache_folder() / "shards"
    bucket = f"{match[1]}://{match[2]}"
    copy = _Copy(_files(match[1]), bucket, root / match[1] / match[2], root, limit)
    folder = copy.place.joinpath(*parts)
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_folder(root, wait=True))
        except OSError as error:
            raise InputError(f"Cannot write to {root}: {error.strerror}. (--cache)") from error
        copy.update(folder)
    return folder


def _files(scheme: str) -> Any:
    """Return fsspec's file system of addresses with a scheme, such as `s3`."""
    try:
        import fsspec

        return fsspec.filesystem(scheme, skip_instance_cache=True)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"Addresses {scheme}://... cannot be read: {quote_text(str(error))}. For s3 and gs: "
            "pip install 'egosim-jax[stores]'. (--latents, --validation)"
        ) from error


@dataclass(frozen=True)
class _Copy:
    """The copy of a bucket in a cache."""

    files: Any
    """File system of fsspec."""
    bucket: str
    """Address of the bucket."""
    place: Path
    """Folder of the bucket's copy."""
    root: Path
    """Folder of the cache."""
    limit: int
    """Maximum size of the cache in bytes."""

    def update(self, folder: Path) -> None:
        """Copy the shards or the mixture of a folder."""
        data = self._document(folder / MANIFEST)
        if data is not None:
            return self._update_shards(folder, data)
        data = self._document(folder / MIXTURE)
        if data is None:
            raise InputError(
                f"{self._address(folder)} has no {MANIFEST}: check the bucket and the folder. "
                "(--latents, --validation)"
            )
        (folder / MANIFEST).unlink(missing_ok=True)  # of shards that were here before
        _write(folder / MIXTURE, data)
        for part in read_mixture(folder):
            inside = Path(os.path.normpath(part))
            if not inside.is_relative_to(self.place):
                raise InputError(
                    f"{self._address(folder / MIXTURE)} names {quote(str(inside))}: the parts of a "
                    "mixture must be in its bucket. Write a mixture of folders of one bucket."
                )
            data = self._document(inside / MANIFEST)
            if data is None:
                raise InputError(
                    f"{self._address(inside)}, a part of the mixture {self._address(folder)}, has "
                    f"no {MANIFEST}: copy it to the bucket."
                )
            self._update_shards(inside, data)

    def _update_shards(self, folder: Path, data: bytes) -> None:
        """Copy the shards of a manifest, then the manifest; remove shards that it does not name."""
        name = self._address(folder / MANIFEST)
        manifest = parse_manifest(parse_json(data, source=name), name)
        missing = [*self._missing(folder, manifest, data)]
        size = sum(shard.size for shard in missing)
        self._check_room(folder, size, missing)
        if missing:
            (folder / MANIFEST).unlink(missing_ok=True)
            with ThreadPoolExecutor(_TRANSFERS) as pool:
                sizes = pool.map(partial(self._fetch, folder), missing)
                for _ in track_bytes(sizes, f"copying {self._address(folder)}", total=size):
                    pass
        names = {shard.file for shard in manifest.shards}
        for path in folder.glob("shard-*.array_record"):
            if path.name not in names:
                path.unlink()
        _write(folder / MANIFEST, data)

    def _missing(self, folder: Path, manifest: Manifest, data: bytes) -> Iterator[ShardInfo]:
        """Yield the shards that the copy lacks. Hashes files unless it was complete before."""
        was_complete = False
        with suppress(InputError):
            was_complete = read_bytes(folder / MANIFEST, limit=MAX_JSON_BYTES) == data
        for shard in manifest.shards:
            differs = bool(file_problems(folder, shard))
            if differs or not (was_complete or sha256(folder / shard.file) == shard.sha256):
                yield shard

    def _check_room(self, folder: Path, size: int, missing: Iterable[ShardInfo]) -> None:
        replaced = {folder / shard.file for shard in missing}
        files = [path for path in self.root.rglob("shard-*.array_record") if path not in replaced]
        held = sum(path.stat().st_size for path in files)
        free = shutil.disk_usage(self.root).free
        if held + size > self.limit or size > free:
            raise InputError(
                f"{self._address(folder)} needs {size / 1e9:.3g} GB in {self.root}, which holds "
                f"{held / 1e9:.3g} of at most {self.limit / 1e9:.3g} GB; {free / 1e9:.3g} GB of "
                "its disk are free. Remove folders there, choose a larger disk (--cache) or a "
                "higher limit (--cache-gb), or mount the bucket and give its folder."
            )

    def _fetch(self, folder: Path, shard: ShardInfo) -> int:
        """Copy a shard and return its size. Raises `InputError` if it differs from the manifest."""
        path = folder / shard.file
        name = self._address(path)
        try:
            with _asking(name), atomic_write(path) as temporary:
                size = self.files.size(name)
                if size == shard.size:
                    self.files.get_file(name, str(temporary))
                if size != shard.size or sha256(temporary) != shard.sha256:
                    raise InputError(
                        f"{name} differs from its manifest, in size ({quote(size)} of "
                        f"{shard.size:,} bytes) or SHA-256. Copy the whole folder to the store "
                        "again."
                    )
        except FileNotFoundError as error:
            raise InputError(
                f"{name} is missing, although its manifest names it. Copy the whole folder to the "
                "store again."
            ) from error
        except ConnectionError as error:
            raise ProcessExit(
                f"{error} Run the same command again: complete shards are kept.",
                ExitCode.RESUBMIT,
            ) from error
        return shard.size

    def _document(self, path: Path) -> bytes | None:
        """Return the JSON document that belongs at a path; None if the store lacks it."""
        name = self._address(path)
        try:
            with _asking(name):
                return self.files.cat_file(name, start=0, end=MAX_JSON_BYTES + 1)
        except FileNotFoundError:
            return None
        except ConnectionError as error:
            raise InputError(
                f"{error} Check the network, the endpoint and the credentials. "
                "(--latents, --validation)"
            ) from error

    def _address(self, path: Path) -> str:
        """Return the address of the original of a file or folder of the copy."""
        inner = path.relative_to(self.place).as_posix()
        return self.bucket if inner == "." else f"{self.bucket}/{inner}"


@contextmanager
def _asking(name: str) -> Iterator[None]:
    """Turn the errors of a store into `InputError` if it refuses, else `ConnectionError`.

    Raises `FileNotFoundError` and errors of this machine's disk as they are.
    """
    try:
        yield
    except (InputError, FileNotFoundError):
        raise
    except PermissionError as error:
        raise InputError(
            f"{name} may not be read: {quote_text(str(error))}. Give this machine credentials that "
            "may read the bucket: aws configure or AWS_PROFILE for s3, gcloud auth "
            "application-default login for gs."
        ) from error
    except Exception as error:  # each store has its own
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        reason = quote_text(f"{type(error).__name__}: {error}")
        raise ConnectionError(f"{name} cannot be read: {reason}.") from error


def _write(path: Path, data: bytes) -> None:
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)
