"""Name tables: foreign tensors to our weights and back.

A table is a list of `Rule`s, each one pattern of a foreign name, the path that it fills, and the
transform between the two. The same table is used in both directions, and every difference is
reported in one list.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from einops import EinopsError, rearrange

from egosim_jax.io.weights import WeightsError, mismatches


@dataclass(frozen=True)
class Rule:
    """One line of a name table.

    `*` in `source` stands for the index of a stacked block; such a rule gathers all layers into
    the leading axis of `target`. `transform` names an entry of `TRANSFORMS`, or is an einops
    pattern itself. `part` (i, n) takes the i-th of n equal parts of the source's first axis: n
    rules share a fused projection.
    """

    source: str
    target: str
    transform: str = "same"
    part: tuple[int, int] = (0, 1)

    @property
    def stacked(self) -> bool:
        """Whether it gathers the layers of a stack."""
        return "*" in self.source

    def ours(self, tensor: np.ndarray) -> np.ndarray:
        """One foreign tensor as ours; raises `ValueError` or `EinopsError` if it does not fit."""
        index, parts = self.part
        return self._transform.ours(np.split(tensor, parts)[index] if parts > 1 else tensor)

    def theirs(self, tensor: np.ndarray) -> np.ndarray:
        """One of our tensors, or one layer, as theirs; one part of it, if they fuse several."""
        return self._transform.theirs(tensor)

    @property
    def _transform(self) -> Transform:
        return TRANSFORMS.get(self.transform) or _layout(self.transform)


@dataclass(frozen=True)
class Transform:
    """A change of layout between a foreign tensor and ours, and its inverse."""

    ours: Callable[[np.ndarray], np.ndarray]
    theirs: Callable[[np.ndarray], np.ndarray]


def _layout(ours: str) -> Transform:
    """The transform of an einops pattern, theirs to ours, that names every axis by itself."""
    left, right = ours.split("->")
    return Transform(
        lambda x: rearrange(x, ours),
        lambda x: rearrange(x, f"{right} -> {left}"),
    )


TRANSFORMS: dict[str, Transform] = {
    "same": Transform(lambda x: x, lambda x: x),
    "linear": _layout("o i -> i o"),
    "conv2d": _layout("o i h w -> h w i o"),
    "conv3d": _layout("o i t h w -> t h w i o"),
}
"""Layout changes by name."""


@dataclass(frozen=True, kw_only=True)
class Leaf:
    """One of our weights, and the foreign tensors that fill it."""

    rule: Rule
    names: tuple[str, ...]
    """One tensor or, for a stack of blocks, one a layer."""
    shape: tuple[int, ...]
    """Of ours."""
    dtype: np.dtype
    """Theirs."""


def assign(
    tensors: Mapping[str, Any],
    rules: Sequence[Rule],
    *,
    ignore: Sequence[str] = (),
    want: Mapping[str, tuple[int, ...]] | None = None,
    source: str = "the checkpoint",
) -> dict[str, Leaf]:
    """What fills each of our paths, from names, shapes and dtypes alone.

    Tensors whose name matches a pattern of `ignore` (`*` stands for anything) are left out, even
    if a rule would read them. Raises `WeightsError` naming every other tensor that no rule reads
    or whose shape does not fit its rule, every rule that found no tensor, every gap in a stack of
    layers, layers that differ in shape or dtype and, where the shapes `want` of our paths are
    given, every path that would be of another.
    """
    found: dict[Rule, dict[int, str]] = {}
    shapes: dict[Rule, set[tuple[tuple[int, ...], np.dtype]]] = {}
    patterns = [(rule, _regex(rule.source)) for rule in rules]
    problems = []
    for name, tensor in tensors.items():
        if any(fnmatchcase(name, pattern) for pattern in ignore):
            continue
        matches = [(rule, hit) for rule, pattern in patterns if (hit := pattern.fullmatch(name))]
        if not matches:
            problems.append(f"{name}: not known to this network's name table")
        for rule, hit in matches:
            layer = int(hit.group(1)) if hit.groups() else 0
            found.setdefault(rule, {})[layer] = name
            try:
                shape = rule.ours(outline(tensor)).shape
            except (EinopsError, ValueError):
                aim = f"a shape that {rule.transform!r} can bring to {rule.target}"
                problems.append(f"{name}: have {tuple(tensor.shape)}, want {aim}")
            else:
                shapes.setdefault(rule, set()).add((shape, np.dtype(tensor.dtype)))
    leaves = {}
    for rule in rules:
        layers, kinds = found.get(rule, {}), shapes.get(rule, set())
        if not layers:
            problems.append(f"{rule.source}: missing (fills {rule.target})")
        elif sorted(layers) != list(range(len(layers))):
            gaps = sorted(set(range(max(layers))) - set(layers))
            more = f" and {len(gaps) - 8} more" if len(gaps) > 8 else ""
            problems.append(f"{rule.source}: layers {gaps[:8]}{more} are missing")
        elif len(kinds) > 1:
            problems.append(f"{rule.source}: the layers differ in shape or dtype")
        elif kinds:
            ((shape, dtype),) = kinds
            stacked = (len(layers), *shape) if rule.stacked else shape
            names = tuple(layers[i] for i in range(len(layers)))
            leaves[rule.target] = Leaf(rule=rule, names=names, shape=stacked, dtype=dtype)
    if want is not None:
        known = {rule.target for rule in rules if rule.target not in leaves}
        problems += mismatches(leaves, {p: s for p, s in want.items() if p not in known})
    if problems:
        raise WeightsError(problems, source=source)
    return leaves


def translate(
    tensors: Mapping[str, np.ndarray],
    rules: Sequence[Rule],
    *,
    ignore: Sequence[str] = (),
    source: str = "the checkpoint",
) -> dict[str, np.ndarray]:
    """Foreign tensors under our paths; raises what `assign` raises."""
    ours = {}
    for path, leaf in assign(tensors, rules, ignore=ignore, source=source).items():
        layers = [leaf.rule.ours(tensors[name]) for name in leaf.names]
        ours[path] = np.stack(layers) if leaf.rule.stacked else layers[0]
    return ours


def translate_back(ours: Mapping[str, np.ndarray], rules: Sequence[Rule]) -> dict[str, np.ndarray]:
    """Our tensors under the foreign names: the inverse of `translate`."""
    parts: dict[str, dict[int, np.ndarray]] = {}
    for rule in rules:
        tensor = ours[rule.target]
        for layer, piece in enumerate(tensor if rule.stacked else [tensor]):
            name = rule.source.replace("*", str(layer))
            parts.setdefault(name, {})[rule.part[0]] = rule.theirs(piece)
    return {
        name: np.concatenate([found[i] for i in sorted(found)]) if len(found) > 1 else found[0]
        for name, found in parts.items()
    }


def outline(tensor: Any) -> np.ndarray:
    """An array of the tensor's shape that takes no memory."""
    return np.broadcast_to(np.zeros((), np.uint8), tuple(tensor.shape))


def _regex(pattern: str) -> re.Pattern[str]:
    """A layer has up to four digits, so that a list of all before it is short."""
    return re.compile(re.escape(pattern).replace(r"\*", "(0|[1-9][0-9]{0,3})"))
