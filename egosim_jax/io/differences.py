"""Differences between a recorded run and this one, in the words of a refusal."""

from __future__ import annotations

import re
from collections.abc import Mapping

from egosim_jax.io.bounded import listing
from egosim_jax.runtime.options import option_of

_DIGEST = re.compile(r"\b([0-9a-f]{8})[0-9a-f]{24,}\b")


def describe(differing: Mapping[str, tuple[str, str]]) -> str:
    """Return one line of the values that the folder has and this run has, by dotted path.

    Options of the command come first, by their names on the command line, and digests last, cut
    to 8 digits. Several fields that follow from one option are one difference.
    """
    found: dict[str, tuple[tuple[bool, bool, int], str]] = {}
    for path, (folder, ours) in differing.items():
        option, text = option_of(path), f"the folder has {folder}, this run has {ours}"
        short = _DIGEST.sub(r"\1…", text)
        name, rank = option or path, (option is None, short != text, len(short))
        found[name] = min(found.get(name, (rank, short)), (rank, short))
    ordered = sorted(found.items(), key=lambda item: item[1])
    return listing([f"{name}: {text}" for name, (_, text) in ordered])
