"""Training checkpoints: the only file that knows Orbax.

A checkpoint holds the training state and the position of the data iterator together, is written
in the background, and is whole or absent: a run that was killed while saving resumes from the
checkpoint before.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as ocp

from egosim_jax.types import InputError

STATE, DATA = "state", "data"


class Checkpoints:
    """The checkpoints of one run folder, newest last."""

    def __init__(self, folder: Path, *, keep: int = 2):
        logging.getLogger("absl").setLevel(logging.WARNING)
        self.folder = folder.absolute()
        preserve = ocp.training.preservation_policies.LatestN(keep)
        always = ocp.training.save_decision_policies.FixedIntervalPolicy(1)
        # Orbax declares protocols that its own policies and pathlib do not meet to the letter.
        self._checkpointer = ocp.training.Checkpointer(
            self.folder,  # pyright: ignore[reportArgumentType]
            preservation_policy=preserve,  # pyright: ignore[reportArgumentType]
            save_decision_policy=always,  # pyright: ignore[reportArgumentType]
            cleanup_tmp_directories=True,
        )

    @property
    def latest(self) -> int | None:
        """Finished updates in the newest checkpoint, or None if there is no checkpoint."""
        newest = self._checkpointer.latest
        return None if newest is None else newest.step

    def save(self, step: int, state: Any, data: Any) -> None:
        """Start saving; waits only for a save that is still running."""
        self._checkpointer.save_checkpointables_async(step, {STATE: state, DATA: data})

    def restore(self, state: Any, data: Any) -> Any:
        """The newest state, placed as the shardings of the abstract `state` say.

        `data` is set to the saved position in place. Raises `InputError` listing the paths that
        differ when the checkpoint was made by another model or optimiser.
        """
        step = self.latest
        if step is None:
            raise InputError(f"There is no checkpoint in {self.folder}.")
        self._check_shapes(step, state)
        try:
            loaded = self._checkpointer.load_checkpointables(step, {STATE: state, DATA: data})
        except Exception as error:
            # Orbax wraps what the data iterator says about a position of other data.
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from error
            raise
        return loaded[STATE]

    def _check_shapes(self, step: int, state: Any) -> None:
        saved = _shapes(self._checkpointer.metadata(step).metadata)
        wanted = _shapes(state)
        problems = [
            f"{path}: checkpoint has {saved.get(path, 'nothing')}, "
            f"config expects {wanted.get(path, 'nothing')}"
            for path in sorted(saved.keys() | wanted.keys())
            if saved.get(path) != wanted.get(path)
        ]
        if problems:
            listing = "\n".join(f"  {line}" for line in problems)
            raise InputError(
                f"The checkpoint of step {step} in {self.folder} is of another model or "
                f"optimiser. Use its config, or another --out:\n{listing}"
            )

    def close(self) -> None:
        """Wait until everything is on disk."""
        self._checkpointer.wait()
        self._checkpointer.close()


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        "/".join(str(getattr(key, "key", getattr(key, "name", key))) for key in path): tuple(
            leaf.shape
        )
        for path, leaf in leaves
    }
