"""Cache of scores in the folder of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from egosim_jax.io.atomic import append_line
from egosim_jax.io.bounded import read_lines

CACHE = "scores_cache.jsonl"
"""Name of the cache file in the folder of a report."""
Scores = Mapping[str, float]
"""Values of one clip by measure."""


@dataclass(frozen=True)
class ScoreCache:
    """Scores by content hash, in a JSON Lines file."""

    path: Path
    """File to read and to append to."""

    @cached_property
    def _known(self) -> dict[str, dict[str, float]]:
        if not self.path.is_file():
            return {}
        lines = [line for _, line in read_lines(self.path) if isinstance(line, dict)]
        return {
            line["key"]: {name: float("nan") if v is None else v for name, v in scores.items()}
            for line in lines
            if isinstance(line.get("key"), str) and isinstance(scores := line.get("scores"), dict)
        }

    def get(self, key: str) -> Scores | None:
        """Return the scores of a key, or None if they are unknown."""
        return self._known.get(key)

    def put(self, key: str, scores: Scores) -> None:
        """Add scores; they are on disk when this returns."""
        self._known[key] = dict(scores)
        plain = {name: None if np.isnan(value) else value for name, value in scores.items()}
        append_line(self.path, {"key": key, "scores": plain})
