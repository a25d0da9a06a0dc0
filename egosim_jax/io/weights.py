"""Weights in and out of safetensors, by a table of names.

A network's own format is one safetensors file whose keys are the dotted paths of its nnx state
(`blocks.self_attn.q.kernel`); stacked blocks keep their leading `layers` axis. Foreign formats are
read through a table of `Rule`s, each one pattern of a foreign name, the path it fills, and the
transform between the two. The same table is used in both directions, and every difference is
reported in one list.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from einops import EinopsError, rearrange
from flax import nnx

from egosim_jax.io.digest import sha256
from egosim_jax.types import InputError


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
"""Layout changes by name; a network's table may pass more of its own."""


class WeightsError(InputError):
    """Weights do not match the network; the message lists every differing path, have and want."""

    def __init__(self, problems: Sequence[str], *, source: str):
        listing = "\n".join(f"  {line}" for line in problems)
        super().__init__(f"{len(problems)} weights of {source} do not match:\n{listing}")
        self.problems = list(problems)


def flat_shapes(module: nnx.Module) -> dict[str, tuple[int, ...]]:
    """Dotted path to shape for every parameter and buffer of a module, abstract or real."""
    return {path: tuple(leaf.shape) for path, leaf in _leaves(module).items()}


def _leaves(module: nnx.Module) -> dict[str, nnx.Variable]:
    state = nnx.state(module, nnx.Not(nnx.RngState))
    return {".".join(map(str, path)): leaf for path, leaf in nnx.to_flat_state(state)}


def translate(
    tensors: Mapping[str, np.ndarray],
    rules: Sequence[Rule],
    *,
    ignore: Sequence[str] = (),
    transforms: Mapping[str, Transform] = TRANSFORMS,
    source: str = "the checkpoint",
) -> dict[str, np.ndarray]:
    """Foreign tensors under our paths.

    Tensors whose name matches a pattern of `ignore` (`*` stands for anything) are left out, even
    if a rule would read them. Raises `WeightsError` naming every other tensor that no rule reads
    or whose shape does not fit its rule, every rule that found no tensor, and every gap in a
    stack of layers.
    """
    found: dict[Rule, dict[int, np.ndarray]] = {}
    unfit: set[Rule] = set()
    patterns = [(rule, _regex(rule.source)) for rule in rules]
    problems = []
    for name, tensor in tensors.items():
        if any(fnmatchcase(name, pattern) for pattern in ignore):
            continue
        matches = [(rule, hit) for rule, pattern in patterns if (hit := pattern.fullmatch(name))]
        if matches:
            for rule, hit in matches:
                layer = int(hit.group(1)) if hit.groups() else 0
                transform = _transform(rule, transforms)
                try:
                    fitted = transform.ours(_part(tensor, rule))
                except (EinopsError, ValueError):
                    want = f"a shape that {rule.transform!r} can bring to {rule.target}"
                    problems.append(f"{name}: have {tensor.shape}, want {want}")
                    unfit.add(rule)
                else:
                    found.setdefault(rule, {})[layer] = fitted
        else:
            problems.append(f"{name}: not known to this network's name table")
    ours = {}
    for rule in rules:
        layers = found.get(rule, {})
        if rule in unfit:
            continue
        if not layers:
            problems.append(f"{rule.source}: missing (fills {rule.target})")
        elif sorted(layers) != list(range(len(layers))):
            gaps = sorted(set(range(max(layers))) - set(layers))
            problems.append(f"{rule.source}: layers {gaps} are missing")
        elif len({tensor.shape for tensor in layers.values()}) > 1:
            problems.append(f"{rule.source}: the layers differ in shape")
        elif "*" in rule.source:
            ours[rule.target] = np.stack([layers[i] for i in range(len(layers))])
        else:
            ours[rule.target] = layers[0]
    if problems:
        raise WeightsError(problems, source=source)
    return ours


def translate_back(
    ours: Mapping[str, np.ndarray],
    rules: Sequence[Rule],
    *,
    transforms: Mapping[str, Transform] = TRANSFORMS,
) -> dict[str, np.ndarray]:
    """Our tensors under the foreign names: the inverse of `translate`."""
    parts: dict[str, dict[int, np.ndarray]] = {}
    for rule in rules:
        tensor, transform = ours[rule.target], _transform(rule, transforms)
        for layer, piece in enumerate(tensor if "*" in rule.source else [tensor]):
            name = rule.source.replace("*", str(layer))
            parts.setdefault(name, {})[rule.part[0]] = transform.theirs(piece)
    return {
        name: np.concatenate([found[i] for i in sorted(found)]) if len(found) > 1 else found[0]
        for name, found in parts.items()
    }


def _transform(rule: Rule, transforms: Mapping[str, Transform]) -> Transform:
    return transforms.get(rule.transform) or _layout(rule.transform)


def _part(tensor: np.ndarray, rule: Rule) -> np.ndarray:
    index, parts = rule.part
    return np.split(tensor, parts)[index] if parts > 1 else tensor


def _regex(pattern: str) -> re.Pattern[str]:
    return re.compile(re.escape(pattern).replace(r"\*", r"(\d+)"))


def fill(
    module: nnx.Module,
    tensors: Mapping[str, Any],
    *,
    dtype: np.dtype | str | None = None,
    source: str = "the checkpoint",
) -> None:
    """Put tensors, keyed by our dotted paths, into a module made for real or by `nnx.eval_shape`.

    `dtype` casts floating tensors; by default they keep their own. Raises `WeightsError` naming
    every path that is missing, unknown or of another shape, before anything is changed.
    """
    leaves = _leaves(module)
    problems = []
    for path in sorted(leaves.keys() | tensors.keys()):
        if path not in tensors:
            problems.append(f"{path}: have nothing, want {tuple(leaves[path].shape)}")
        elif path not in leaves:
            problems.append(f"{path}: have {tensors[path].shape}, want nothing")
        elif tensors[path].shape != tuple(leaves[path].shape):
            have, want = tensors[path].shape, tuple(leaves[path].shape)
            problems.append(f"{path}: have {have}, want {want}")
    if problems:
        raise WeightsError(problems, source=source)
    import jax.numpy as jnp

    state = nnx.state(module, nnx.Not(nnx.RngState))
    for path, leaf in nnx.to_flat_state(state):
        tensor = jnp.asarray(tensors[".".join(map(str, path))])
        leaf.set_value(tensor.astype(dtype) if dtype is not None else tensor)
    nnx.update(module, state)


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a weights folder, by network."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of weights. (--weights)")
    return {path.stem: sha256(path) for path in sorted(folder.glob("*.safetensors"))}


def save(path: Path, module: nnx.Module, *, dtype: str | None = None) -> None:
    """Write a module's weights as safetensors: to a temporary name, then renamed.

    `dtype` casts floating tensors; by default they keep their own.
    """
    from safetensors.flax import save_file

    tensors = {name: leaf.get_value() for name, leaf in _leaves(module).items()}
    if dtype is not None:
        tensors = {name: tensor.astype(dtype) for name, tensor in tensors.items()}
    temporary = path.with_name(path.name + ".tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary.touch()
    mode = temporary.stat().st_mode
    save_file(tensors, temporary)
    temporary.chmod(mode)  # safetensors' own is for the owner alone
    temporary.replace(path)


def load(path: Path, module: nnx.Module, *, dtype: str | None = None) -> None:
    """Fill a module from a file that `save` wrote."""
    if not path.is_file():
        raise InputError(f"No weights at {path}. (--weights must name a folder that holds it.)")
    from safetensors import SafetensorError
    from safetensors.flax import load_file

    try:
        tensors = load_file(path)
    except SafetensorError as error:
        raise InputError(f"{path} is not a readable safetensors file: {error}.") from error
    fill(module, tensors, dtype=dtype, source=str(path))
