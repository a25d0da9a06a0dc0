"""Windows of the parts that an encoding writes (`encode.py`), and those that were skipped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.data.manifest import MANIFEST
from egosim_jax.io.bounded import read_json
from egosim_jax.io.run import write_json

Window = tuple[int, int]
"""Record number and first frame of a window."""


@dataclass(frozen=True)
class PartWindows:
    """The windows of one part, as listed in a file next to its folder."""

    windows: Sequence[Window]
    """Windows of the part, in order; none if there is no list yet."""
    skipped: Sequence[Window]
    """Windows among them that could not be read."""

    @classmethod
    def read(cls, part: Path) -> PartWindows:
        """Read the list of a part."""
        path = part.with_suffix(".json")
        found = read_json(path) if path.exists() else {"windows": [], "skipped": []}
        windows, skipped = (
            [(number, start) for number, start in found[name]] for name in ("windows", "skipped")
        )
        return cls(windows, skipped)

    def write(self, part: Path) -> None:
        """Write the list of a part; the part itself must be complete later than its list."""
        write_json(part.with_suffix(".json"), {"windows": self.windows, "skipped": self.skipped})

    @property
    def is_empty(self) -> bool:
        """True if all windows were skipped, so that the part has no shard."""
        return bool(self.windows) and self.windows == self.skipped

    def is_done(self, part: Path, todo: Sequence[Window]) -> bool:
        """Return whether a part is written, and has these windows."""
        written = self.is_empty or (part / MANIFEST).exists()
        return written and self.windows == list(todo)
