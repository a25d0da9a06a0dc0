"""Conversions of tensors in memory, for tests: the product streams them from file to file."""

from collections.abc import Mapping, Sequence

import numpy as np

from egosim_jax.convert.rules import Rule, assign


def translate(
    tensors: Mapping[str, np.ndarray],
    rules: Sequence[Rule],
    *,
    ignore: Sequence[str] = (),
    source: str = "the checkpoint",
) -> dict[str, np.ndarray]:
    """Convert foreign tensors to weights by path; raises what `assign` raises."""
    weights = {}
    for path, leaf in assign(tensors, rules, ignore=ignore, source=source).items():
        layers = [leaf.rule.to_jax(tensors[name]) for name in leaf.names]
        weights[path] = np.stack(layers) if leaf.rule.stacked else layers[0]
    return weights


def translate_back(
    weights: Mapping[str, np.ndarray], rules: Sequence[Rule]
) -> dict[str, np.ndarray]:
    """Convert weights to foreign tensors: the inverse of `translate`."""
    parts: dict[str, dict[int, np.ndarray]] = {}
    for rule in rules:
        tensor = weights[rule.target]
        for layer, piece in enumerate(tensor if rule.stacked else [tensor]):
            name = rule.source.replace("*", str(layer))
            parts.setdefault(name, {})[rule.part[0]] = rule.to_torch(piece)
    return {
        name: np.concatenate([found[i] for i in sorted(found)]) if len(found) > 1 else found[0]
        for name, found in parts.items()
    }
