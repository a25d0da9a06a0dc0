"""Short texts and images of data, for consoles and notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from typing import Any

import numpy as np

MAX_SHOWN = 3
"""Length up to which a tuple is written out."""


class Shown:
    """Dataclass whose `repr` has the sizes of its arrays, and which notebooks show as images.

    Its decorator must have `repr=False`.
    """

    def __repr__(self) -> str:
        """Return the name and the fields, those that are empty or None omitted."""
        shown: Any = self  # a dataclass
        texts = []
        for field in fields(shown):
            value = getattr(self, field.name)
            if not (value is None or (isinstance(value, (Mapping, tuple)) and not value)):
                texts.append(f"{field.name}={_short(value)}")
        return f"{type(self).__name__}({', '.join(texts)})"

    def _repr_html_(self) -> str:
        # Images are drawn above the types, when a notebook asks for one.
        drawn: str = import_module("egosim_jax.simulation.notebook").html(self)
        return drawn


def _short(value: Any) -> str:
    """Return an array as dtype and shape, and a long collection as its length."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, Mapping):
        texts = [f"{key!r}: {_short(item)}" for key, item in list(value.items())[:MAX_SHOWN]]
        more = [f"… {len(value)} in all"] if len(value) > MAX_SHOWN else []
        return "{" + ", ".join(texts + more) + "}"
    if isinstance(value, (tuple, list)):
        texts = [_short(item) for item in value[:MAX_SHOWN]]
        more = [f"… {len(value)} in all"] if len(value) > MAX_SHOWN else []
        return f"({', '.join(texts + more)})"
    return repr(value)
