"""Training checkpoints: the only file that knows Orbax.

A checkpoint holds the training state and the position of the data iterator together, is written
in the background, and is whole or absent: a run that was killed while saving resumes from the
checkpoint before. Once it is whole, the hashes of its files are written into it, because Orbax
reads a changed byte as if nothing were wrong; they are compared before it is read.
"""

from __future__ import annotations

import logging
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import jax
from jax.experimental import multihost_utils
from orbax.checkpoint import v1 as ocp

from egosim_jax.io.atomic import TEMPORARY
from egosim_jax.io.digest import sha256
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted import listing, quote_text, read_json
from egosim_jax.types import InputError

STATE, DATA = "state", "data"
HASHES = "sha256.json"
"""In the folder of a checkpoint: the hash of every other file in it."""


class Checkpoints:
    """The checkpoints of one run folder: the newest `keep`, and those of every `keep_every` steps.

    Close it, also after an error: saving goes on in a thread. Raises `InputError` if what Orbax
    has to know of a checkpoint before it reads any is damaged.
    """

    def __init__(self, folder: Path, *, keep: int = 2, keep_every: int | None = None):
        logging.getLogger("absl").setLevel(logging.CRITICAL)  # what goes wrong is raised, too
        self.folder, self.keep = folder.absolute(), keep
        policies = ocp.training.preservation_policies
        preserve: Any = [policies.LatestN(keep)]
        if keep_every is not None:
            preserve.append(policies.EveryNSteps(keep_every))
        always = ocp.training.save_decision_policies.FixedIntervalPolicy(1)
        try:
            # Orbax declares protocols that its own policies and pathlib do not meet to the letter.
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
                f"{listing(damage) or quote_text(str(error))}. Bring the files back, or move the "
                "damaged checkpoint away."
            ) from error
        self._thread = ThreadPoolExecutor(1)
        self._saving: tuple[int, Future[None]] | None = None
        if self.steps and not (self.folder / str(self.steps[-1]) / HASHES).exists():
            self._write_hashes(self.steps[-1])  # it was killed just then

    @property
    def steps(self) -> list[int]:
        """Finished updates in each checkpoint, oldest first."""
        return sorted(checkpoint.step for checkpoint in self._checkpointer.checkpoints)

    def check_room(self, state: Any) -> None:
        """Raise `InputError` unless the disk has room for the checkpoints that will be kept."""
        sizes = [leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)]
        # The newest one is whole before the oldest one goes.
        need = sum(sizes) * (self.keep + 1 - min(self.keep, len(self.steps)))
        free = shutil.disk_usage(self.folder).free
        if free < need:
            raise InputError(
                f"The disk of {self.folder} has {free / 1e9:.1f} GB free, and checkpoints will "
                f"take {need / 1e9:.1f} GB: free space, keep fewer or choose another disk. "
                "(--training.keep, --out)"
            )

    def save(self, step: int, state: Any, data: Any) -> None:
        """Start saving; waits only for a save that is still running.

        Raises what `wait` raises, of the save before.
        """
        self.wait()
        with self._explained(step):
            saved = {STATE: state, DATA: data}
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
        """Say of a full disk what was not saved, and what stands."""
        try:
            yield
        except Exception as error:
            if not any("No space left" in str(cause) for cause in _causes(error)):
                raise
            kept = max((kept for kept in self.steps if kept < step), default=None)
            stands = "there is none before it" if kept is None else f"that of step {kept} stands"
            raise InputError(
                f"The disk of {self.folder} is full: the checkpoint of step {step} was not saved, "
                f"{stands}. Free space and run the same command again. (--out)"
            ) from error

    def restore(self, state: Any, data: Any, *, fallback: bool = False) -> Any:
        """The newest state, placed as the shardings of the abstract `state` say.

        `data` is set to the saved position in place. With `fallback` a damaged checkpoint is set
        aside and the one before it taken. Raises `InputError` naming the damaged files, or listing
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
                    f"{message} Bring the files back, or take the checkpoint before it. "
                    "(--training.fallback)"
                )
            print(message, file=sys.stderr)
            self._set_aside(step)
        raise InputError(f"There is no sound checkpoint in {self.folder}.")

    def close(self) -> None:
        """Wait until everything is on disk."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()
            with suppress(OSError, ValueError):  # the failure of a save, which was raised before
                self._checkpointer.close()

    def _seal(self, step: int, response: Any) -> None:
        """Once the checkpoint is whole, write the hashes of its files into it."""
        response.result()
        self._write_hashes(step)

    def _write_hashes(self, step: int) -> None:
        if jax.process_index() == 0:
            folder = self.folder / str(step)
            digests = {name: sha256(file) for name, file in _files(folder).items()}
            write_json(folder / HASHES, digests)

    def _damage(self, step: int) -> list[str]:
        """Which files of a checkpoint are not as they were written.

        A run that was killed before the hashes were there left a checkpoint that is whole.
        """
        folder = self.folder / str(step)
        if not (folder / HASHES).exists():
            return []
        try:
            wanted = read_json(folder / HASHES)
        except InputError as error:
            return [str(error).removesuffix(".")]
        if not isinstance(wanted, dict):
            return [f"{folder / HASHES} holds no hashes"]
        files = _files(folder)
        missing = [
            f"{folder / quote_text(name)} is missing"
            for name in sorted(wanted.keys() - files.keys())
        ]
        return missing + [
            f"{files[name]} is not what was written"
            for name in sorted(wanted.keys() & files.keys())
            if sha256(files[name]) != wanted[name]
        ]

    def _set_aside(self, step: int) -> None:
        multihost_utils.sync_global_devices(f"damaged {step}")  # all have looked at it
        if jax.process_index() == 0:
            aside = self.folder.with_name("damaged") / str(step)
            shutil.rmtree(aside, ignore_errors=True)
            aside.parent.mkdir(exist_ok=True)
            (self.folder / str(step)).rename(aside)
        multihost_utils.sync_global_devices(f"set aside {step}")
        self._checkpointer.reload()

    def _load(self, step: int, state: Any, data: Any) -> Any:
        try:
            self._check_shapes(step, state)
            loaded = self._checkpointer.load_checkpointables(step, {STATE: state, DATA: data})
        except InputError:
            raise
        except Exception as error:
            # Orbax wraps what the data iterator says about a position of other data.
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from error
            raise InputError(
                f"The checkpoint of step {step} in {self.folder} cannot be read, although its "
                f"files are those of {HASHES}: {quote_text(str(error))}. Move it away to take the "
                "one before it."
            ) from error
        return loaded[STATE]

    def _check_shapes(self, step: int, state: Any) -> None:
        saved = _shapes(self._checkpointer.metadata(step).metadata)
        wanted = _shapes(state)
        if not saved:
            raise ValueError("it lists no arrays")
        problems = [
            f"{path}: checkpoint has {saved.get(path, 'nothing')}, "
            f"config expects {wanted.get(path, 'nothing')}"
            for path in sorted(saved.keys() | wanted.keys())
            if saved.get(path) != wanted.get(path)
        ]
        if problems:
            raise InputError(
                f"The checkpoint of step {step} in {self.folder} is of another model or "
                f"optimizer. Use its config, or another --out: {listing(problems)}."
            )


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _is_ours(path: Path) -> bool:
    """Whether it is the file of hashes, or what a kill left of it."""
    return path.name == HASHES or (path.name.startswith(".sha256.") and TEMPORARY in path.name)


def _files(folder: Path) -> dict[str, Path]:
    found = (path for path in folder.rglob("*") if path.is_file() and not _is_ours(path))
    return {str(path.relative_to(folder)): path for path in sorted(found)}


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        "/".join(str(getattr(key, "key", getattr(key, "name", key))) for key in path): tuple(
            leaf.shape
        )
        for path, leaf in leaves
    }
