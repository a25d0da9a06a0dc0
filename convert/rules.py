"""Rules that map the tensors of a foreign checkpoint to weights and back.

Each `Rule` of a conversion table has a pattern of a foreign name, the path of a weight, and the
transform between the two. The same rules serve both directions. One error lists all mismatches.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from einops import EinopsError, rearrange

from egosim_jax.convert.finite import is_floating
from egosim_jax.io.weights import WeightsError, mismatches

LAYOUTS = {
    "same": "... -> ...",
    "linear": "o i -> i o",
    "conv2d": "o i h w -> h w i o",
    "conv3d": "o i t h w -> t h w i o",
}
"""Changes of axis layout by name."""


@dataclass(frozen=True)
class Rule:
    """Correspondence between one foreign tensor, or one per layer, and one weight.

    A `*` in `source` matches the layer index of a stacked block; such a rule stacks all layers
    along the leading axis of `target`. `transform` is a key of `LAYOUTS`, or an einops pattern from
    the foreign layout to ours without composed axes. `part` (i, n) is the i-th of n equal parts of
    the source's first axis: n rules share a fused projection.
    """

    source: str
    target: str
    transform: str = "same"
    part: tuple[int, int] = (0, 1)

    @property
    def stacked(self) -> bool:
        """True if the rule stacks one tensor per layer."""
        return "*" in self.source

    def to_jax(self, tensor: np.ndarray) -> np.ndarray:
        """Convert one foreign tensor. Raises `ValueError` or `EinopsError` if it does not fit."""
        index, parts = self.part
        array = np.split(tensor, parts)[index] if parts > 1 else tensor
        return rearrange(np.asarray(array), self._pattern)

    def to_torch(self, weight: np.ndarray) -> np.ndarray:
        """Convert one weight, or one layer of it, to the foreign tensor or its part."""
        theirs, ours = self._pattern.split("->")
        return rearrange(np.asarray(weight), f"{ours} -> {theirs}")

    @property
    def _pattern(self) -> str:
        return LAYOUTS.get(self.transform, self.transform)


def linear_rules(theirs: str, ours: str, part: tuple[int, int] = (0, 1)) -> list[Rule]:
    """Return the rules of a linear layer with a bias, or of one part of a fused layer."""
    return [
        Rule(f"{theirs}.weight", f"{ours}.kernel", "linear", part),
        Rule(f"{theirs}.bias", f"{ours}.bias", part=part),
    ]


def linears_rules(theirs: str, ours: str, names: Mapping[str, str]) -> list[Rule]:
    """Return the rules of linear layers with biases, by the ends of their names."""
    return [
        rule
        for end, our_end in names.items()
        for rule in linear_rules(f"{theirs}.{end}", f"{ours}.{our_end}")
    ]


def norm_rules(theirs: str, ours: str) -> list[Rule]:
    """Return the rules of a norm with scale and bias."""
    return [Rule(f"{theirs}.weight", f"{ours}.scale"), Rule(f"{theirs}.bias", f"{ours}.bias")]


@dataclass(frozen=True, kw_only=True)
class Leaf:
    """A weight and the foreign tensors that fill it."""

    rule: Rule
    names: tuple[str, ...]
    """Foreign tensor names: one or, for stacked blocks, one per layer."""
    shape: tuple[int, ...]
    dtype: np.dtype
    """Dtype of the foreign tensors; the widest if they have several."""


def assign(
    tensors: Mapping[str, Any],
    rules: Sequence[Rule],
    *,
    ignore: Sequence[str] = (),
    want: Mapping[str, tuple[int, ...]] | None = None,
    mixed: bool = False,
    source: str = "the checkpoint",
) -> dict[str, Leaf]:
    """Match foreign tensors to weights by name, shape and dtype, without reading values.

    Skips tensors that match a pattern of `ignore` (`*` matches anything). Raises `WeightsError`
    listing every other tensor without a rule or with a wrong shape, every rule without a tensor,
    every missing layer, layers that differ in shape or dtype and, if `want` has the shapes of the
    weights by path, every weight of another shape. With `mixed`, layers may differ in their
    floating dtypes.
    """
    found: dict[Rule, dict[int, str]] = {}
    shapes: dict[Rule, set[tuple[int, ...]]] = {}
    dtypes: dict[Rule, set[np.dtype]] = {}
    patterns = [(rule, _regex(rule.source)) for rule in rules]
    problems = []
    for name, tensor in tensors.items():
        if any(fnmatchcase(name, pattern) for pattern in ignore):
            continue
        matches = [(rule, hit) for rule, pattern in patterns if (hit := pattern.fullmatch(name))]
        if not matches:
            problems.append(f"{name}: not in the conversion table of this network")
        for rule, hit in matches:
            layer = int(hit.group(1)) if hit.groups() else 0
            found.setdefault(rule, {})[layer] = name
            try:
                shape = rule.to_jax(shape_only(tensor)).shape
            except (EinopsError, ValueError):
                aim = f"a shape that {rule.transform!r} maps to {rule.target}"
                problems.append(f"{name}: has shape {tuple(tensor.shape)}; expected {aim}")
            else:
                shapes.setdefault(rule, set()).add(shape)
                dtypes.setdefault(rule, set()).add(np.dtype(tensor.dtype))
    leaves = {}
    for rule in rules:
        layers, fits = found.get(rule, {}), shapes.get(rule, set())
        kinds = dtypes.get(rule, set())
        if not layers:
            problems.append(f"{rule.source}: missing (fills {rule.target})")
        elif sorted(layers) != list(range(len(layers))):
            gaps = sorted(set(range(max(layers))) - set(layers))
            more = f" and {len(gaps) - 8} more" if len(gaps) > 8 else ""
            problems.append(f"{rule.source}: layers {gaps[:8]}{more} are missing")
        elif len(fits) > 1:
            problems.append(f"{rule.source}: the layers differ in shape")
        elif len(kinds) > 1 and not (mixed and all(map(is_floating, kinds))):
            listed = " and ".join(sorted(kind.name for kind in kinds))
            problems.append(f"{rule.source}: the layers are {listed}: store one dtype (--dtype)")
        elif fits:
            (shape,) = fits
            stacked = (len(layers), *shape) if rule.stacked else shape
            names = tuple(layers[i] for i in range(len(layers)))
            dtype = max(kinds, key=lambda kind: (kind.itemsize, kind.name))
            leaves[rule.target] = Leaf(rule=rule, names=names, shape=stacked, dtype=dtype)
    if want is not None:
        # A target without a leaf is in `problems` already: do not also report it as missing.
        known = {rule.target for rule in rules if rule.target not in leaves}
        problems += mismatches(leaves, {p: s for p, s in want.items() if p not in known})
    if problems:
        raise WeightsError(problems, source=source)
    return leaves


def shape_only(tensor: Any) -> np.ndarray:
    """Return an array of the tensor's shape that takes no memory (strides of 0)."""
    return np.broadcast_to(np.zeros((), np.uint8), tuple(tensor.shape))


def _regex(pattern: str) -> re.Pattern[str]:
    """Compile a pattern; layer indices have at most four digits, which bounds the gaps."""
    return re.compile(re.escape(pattern).replace(r"\*", "(0|[1-9][0-9]{0,3})"))
