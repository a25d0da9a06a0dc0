"""Training checkpoints, in the only module that uses Orbax.

A checkpoint holds the training state together with the position of the data iterator. It is written
atomically in the background: a run that is killed while saving resumes from the previous
checkpoint. The hashes of its files are added when it is complete and compared before it is read,
because Orbax does not notice a changed byte.
"""

from __future__ import annotations

import errno
import shutil
import sys
from collections.abc import Awaitable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import jax
from jax.experimental import multihost_utils
from orbax.checkpoint import v1 as ocp

from egosim_jax.io.atomic import TEMPORARY
from egosim_jax.io.bounded import listing, quote_text, read_json
from egosim_jax.io.digest import sha256
from egosim_jax.io.run import write_json
from egosim_jax.runtime.failures import system_error
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

STATE, DATA = "state", "data"
POSITION = "position.json"
"""File in the folder of the data with the position of its iterator."""
HASHES = "sha256.json"
"""File in a checkpoint's folder with the hashes of all its other files."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""System errors of a full disk or quota."""


def has_checkpoint(run: Path) -> bool:
    """Return whether a run folder has a checkpoint."""
    return any(path.name.isdigit() for path in (run / "checkpoints").glob("*"))


class Checkpoints:
    """The checkpoints of one run folder: the newest `keep`, and one every `keep_every` steps.

    Close it, even after an error, because saving continues in a thread. Raises `InputError` if the
    metadata that Orbax reads first is damaged.
    """

    def __init__(self, folder: Path, *, keep: int = 2, keep_every: int | None = None):
        self.folder, self.keep, self.keep_every = folder.absolute(), keep, keep_every
        policies = ocp.training.preservation_policies
        preserve: Any = [policies.LatestN(keep)]
        if keep_every is not None:
            preserve.append(policies.EveryNSteps(keep_every))
        # The training loop decides when to save; Orbax must not skip a step.
        always = ocp.training.save_decision_policies.FixedIntervalPolicy(1)
        try:
            # Orbax declares protocols that its policies and pathlib do not satisfy exactly.
            self._checkpointer = ocp.training.Checkpointer(
                self.folder,  # pyright: ignore[reportArgumentType]
                preservation_policy=policies.AnyPreservationPolicy(preserve),  # pyright: ignore[reportArgumentType]
                save_decision_policy=always,  # pyright: ignore[reportArgumentType]
                cleanup_tmp_directories=True,
            )
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            steps = sorted(int(path.name) for path in self.folder.iterdir() if path.name.isdigit())
            damage = [line for step in steps for line in self._damage(step)]
            raise InputError(
                f"The checkpoints in {self.folder} cannot be listed: "
                f"{listing(damage) or quote_text(str(error))}. Restore the files, or move the "
                "damaged checkpoint away."
            ) from error
        self._thread = ThreadPoolExecutor(1)
        self._saving: tuple[int, Future[None]] | None = None
        if self.steps and not (self.folder / str(self.steps[-1]) / HASHES).exists():
            self._write_hashes(self.steps[-1])  # the run was killed before it did

    @property
    def steps(self) -> list[int]:
        """Steps of the checkpoints, ascending."""
        return sorted(checkpoint.step for checkpoint in self._checkpointer.checkpoints)

    def check_room(self, state: Any, saved: Sequence[int]) -> None:
        """Raise `InputError` unless the disk has room for the checkpoints that will be kept.

        `saved` are the steps of the future checkpoints.
        """
        sizes = [leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)]
        steps = [*self.steps, *saved]
        every = self.keep_every
        older = sum(every is not None and step % every == 0 for step in steps[: -self.keep])
        # The newest one is complete before the oldest one is deleted.
        peak = min(len(steps), older + self.keep + 1)
        need = sum(sizes) * (peak - len(self.steps))
        free = shutil.disk_usage(self.folder).free
        if free < need:
            raise InputError(
                f"The disk of {self.folder} has {free / 1e9:.1f} GB free, and checkpoints will "
                f"take {need / 1e9:.1f} GB: free space, keep fewer or choose another disk. "
                "(--training.keep, --training.keep-every, --out)"
            )

    def save(self, step: int, state: Any, data: Any) -> None:
        """Start saving in the background, after the previous save has ended.

        Raises the error of the previous save, as `wait` does.
        """
        self.wait()
        with self._explained(step):
            saved = {STATE: state, DATA: _Position(data)}
            response = self._checkpointer.save_checkpointables_async(step, saved)
        if response is not None:
            self._saving = step, self._thread.submit(self._seal, step, response)

    def wait(self) -> None:
        """Wait until the last save is on disk. Raises `InputError` if the disk is full."""
        if self._saving is not None:
            (step, saving), self._saving = self._saving, None
            with self._explained(step):
                saving.result()

    @contextmanager
    def _explained(self, step: int) -> Iterator[None]:
        """Raise `InputError` for a full disk or quota, with the step and the newest checkpoint."""
        try:
            yield
        except Exception as error:
            if (failure := system_error(error)) is None or failure[0] not in DISK_FULL:
                raise
            kept = max((kept for kept in self.steps if kept < step), default=None)
            newest = "there is no other" if kept is None else f"the newest is of step {kept}"
            raise InputError(
                f"The disk of {self.folder} is full: the checkpoint of step {step} was not saved, "
                f"{newest}. Free space and run the same command again. (--out)"
            ) from error

    def restore(self, state: Any, data: Any, *, fallback: bool = False) -> Any:
        """Return the newest state, with the shardings of the abstract `state`.

        `data` is set to the saved position in place. With `fallback`, a damaged checkpoint is moved
        away and the previous one is used. Raises `InputError` naming the damaged files, or listing
        the paths that differ when the checkpoint was made by another model or optimizer.
        """
        for step in reversed(self.steps):
            damage = self._damage(step)
            if not damage:
                return self._load(step, state, data)
            message = f"The checkpoint of step {step} in {self.folder} is damaged"
            message += f": {listing(damage)}."
            if not fallback:
                raise InputError(
                    f"{message} Restore the files, or use the checkpoint before it. "
                    "(--training.fallback)"
                )
            print(printable(message), file=sys.stderr)
            self._set_aside(step)
        raise InputError(f"There is no valid checkpoint in {self.folder}.")

    def close(self) -> None:
        """Wait until all saves are on disk, and end the thread."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()
            with suppress(OSError, ValueError):  # the failure of a save, which was raised before
                self._checkpointer.close()

    def _seal(self, step: int, response: Any) -> None:
        """Write the hashes of a checkpoint's files into it, once it is complete."""
        response.result()
        self._write_hashes(step)

    def _write_hashes(self, step: int) -> None:
        if jax.process_index() == 0:
            folder = self.folder / str(step)
            digests = {name: sha256(file) for name, file in _files(folder).items()}
            write_json(folder / HASHES, digests)

    def _damage(self, step: int) -> list[str]:
        """Return a line for each file of a checkpoint that differs from its hash.

        A checkpoint without hashes counts as undamaged: the run was killed before they were
        written.
        """
        folder = self.folder / str(step)
        if not (folder / HASHES).exists():
            return []
        try:
            wanted = read_json(folder / HASHES)
        except InputError as error:
            return [str(error).removesuffix(".")]
        if not isinstance(wanted, dict):
            return [f"{folder / HASHES} has no hashes"]
        files = _files(folder)
        missing = [
            f"{folder / quote_text(name)} is missing"
            for name in sorted(wanted.keys() - files.keys())
        ]
        return missing + [
            f"{files[name]} differs from its hash"
            for name in sorted(wanted.keys() & files.keys())
            if sha256(files[name]) != wanted[name]
        ]

    def _set_aside(self, step: int) -> None:
        multihost_utils.sync_global_devices(f"damaged {step}")  # all have checked it
        if jax.process_index() == 0:
            aside = self.folder.with_name("damaged") / str(step)
            shutil.rmtree(aside, ignore_errors=True)
            aside.parent.mkdir(exist_ok=True)
            (self.folder / str(step)).rename(aside)
        multihost_utils.sync_global_devices(f"set aside {step}")
        self._checkpointer.reload()

    def _load(self, step: int, state: Any, data: Any) -> Any:
        try:
            self._check_shapes(step, self._checkpointer.metadata(step).metadata, state)
            wanted = {STATE: state, DATA: _Position(data)}
            loaded = self._checkpointer.load_checkpointables(step, wanted)
        except InputError:
            raise
        except Exception as error:
            # Orbax wraps the data iterator's error about a position in other data.
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from error
            raise InputError(
                f"The checkpoint of step {step} in {self.folder} cannot be read, although its "
                f"files match {HASHES}: {quote_text(str(error))}. Move it away to resume from the "
                "one before it."
            ) from error
        return loaded[STATE]

    def _check_shapes(self, step: int, metadata: Any, state: Any) -> None:
        saved, wanted = _shapes(metadata), _shapes(state)
        if not saved:
            raise ValueError("its metadata lists no arrays")
        problems = [
            f"{path}: checkpoint has {saved.get(path, 'nothing')}, "
            f"config expects {wanted.get(path, 'nothing')}"
            for path in sorted(saved.keys() | wanted.keys())
            if saved.get(path) != wanted.get(path)
        ]
        if problems:
            raise InputError(
                f"The checkpoint of step {step} in {self.folder} was made by another model or "
                f"optimizer. Use its config, or another --out: {listing(problems)}."
            )


class _Position:
    """Position of a data iterator, the same on all processes: the first one writes it.

    Orbax saves and loads any object with these two methods in its own folder.
    """

    def __init__(self, data: Any):
        self.data = data

    async def save(self, directory: Any) -> Awaitable[None]:
        """Return the writing of the present position."""
        position = self.data.get_state()

        async def write() -> None:
            folder = await directory.await_creation()
            if jax.process_index() == 0:
                write_json(Path(folder) / POSITION, position)

        return write()

    async def load(self, directory: Any) -> Awaitable[None]:
        """Return the reading of a saved position into the iterator."""

        async def read() -> None:
            self.data.set_state(read_json(Path(directory) / POSITION))

        return read()


def _is_hashes(path: Path) -> bool:
    """Return whether a path is the file of hashes, or its temporary file of a killed run."""
    return path.name == HASHES or (path.name.startswith(".sha256.") and TEMPORARY in path.name)


def _files(folder: Path) -> dict[str, Path]:
    found = (path for path in folder.rglob("*") if path.is_file() and not _is_hashes(path))
    return {str(path.relative_to(folder)): path for path in sorted(found)}


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        "/".join(str(getattr(key, "key", getattr(key, "name", key))) for key in path): tuple(
            leaf.shape
        )
        for path, leaf in leaves
    }
