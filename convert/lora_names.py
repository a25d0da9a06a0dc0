"""Names of tensors in LoRA files: a prefix, a layer, an adapter, and the role of the tensor.

The prefix is any text that ends with a dot, as in other checkpoints, or the start of kohya's names,
which have underscores for dots. The layer has a name in one of the namings of the network's table.
PEFT's names can also have an adapter: `lora_A.NAME.weight`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io.bounded import listing, quote
from egosim_jax.models import NetworkConfig
from egosim_jax.types import InputError

KOHYA = ("lora_unet_", "lora_transformer_", "lycoris_", "_")
"""Prefixes of names with underscores for dots."""
PREFIXES = (
    "base_model.model.", "diffusion_model.", "model.", "transformer.", "pipe.dit.", "dit.", *KOHYA,
)  # fmt: skip
"""Prefixes of other projects, which one LoRA can mix."""
TEXT = re.compile(r"(^|\.)(lora_te|text_encoders?\.)")
"""Prefixes of a text encoder's layers, which are skipped."""
LOW_RANK = {
    "lora_A": "down", "lora_down": "down", "lora.down": "down",
    "lora_B": "up", "lora_up": "up", "lora.up": "up", "alpha": "alpha",
}  # fmt: skip
"""Role of a low-rank tensor by the suffix of its name."""
FULL = {"diff": "weight", "diff_b": "bias", "diff_m": "modulation"}
"""Kind of weight of a full difference by the suffix of its name."""
SUFFIX = re.compile(
    rf"\.({'|'.join(map(re.escape, (*LOW_RANK, *FULL)))})(?:\.(?!weight$)([^.]+))?(\.weight)?$"
)
SAVED = re.compile(r"\.modules_to_save(\.default)?")
"""PEFT's infix in the names of weights in full."""
OTHERS = {
    "DoRA": r"lora_magnitude_vector|dora_scale|magnitude", "LoHa": r"hada_\w+",
    "LoKr": r"lokr_\w+", "OFT": r"oft_\w+|boft_\w+", "IA3": r"ia3_\w+", "VeRA": r"vera_\w+",
    "AdaLoRA": r"lora_E|ranknum", "LoRA of embeddings": r"lora_embedding_[AB]",
    "LoRA with a middle factor": "lora_mid",
    "LoRA with biases (lora_bias)": r"lora_[AB](?:\.[^.]+)?\.bias",
}  # fmt: skip
"""Adapters that are not read, and the names of their tensors."""
OTHER = {kind: re.compile(rf"(?:^|\.)(?:{names})(?:\.|$)") for kind, names in OTHERS.items()}


@dataclass(frozen=True)
class Location:
    """A weight, or one layer of a stacked weight."""

    target: str
    """Path of the weight."""
    layer: int | None
    """Index of the block; None for a weight that is not stacked."""
    rule: Rule = field(compare=False)
    """Conversion rule of the naming that matched."""

    @property
    def path(self) -> str:
        """Path of the layer if the weight is a kernel, else of the weight."""
        return self.target.removesuffix(".kernel")

    def __str__(self) -> str:
        return self.path if self.layer is None else f"{self.path}, block {self.layer}"


class Name(NamedTuple):
    """Parts of the name of a tensor in a LoRA file."""

    key: str
    """The complete name."""
    prefix: str
    """Text before the name of the layer."""
    layer: str
    """Name of the layer, with underscores for dots; of the weight, if the role is `value`."""
    location: Location
    """Weight that the tensor changes."""
    role: str
    """`down`, `up`, `alpha`, a key of `FULL`, or `value` for a weight in full."""
    adapter: str | None
    """Name of the adapter, if any."""

    @property
    def owner(self) -> str:
        """Name of the layer of a weight in full, with its prefix."""
        return SAVED.sub("", self.key).rpartition(".")[0]


def locations(config: NetworkConfig) -> dict[str, Location]:
    """Return the weights by their plain names in all namings; earlier namings take precedence."""
    known: dict[str, Location] = {}
    for naming in table_of(config).namings.values():
        named = locations_by_name(config, naming.rules(config))
        known = {_plain(name): location for name, location in named.items()} | known
    return known


def locations_by_name(config: NetworkConfig, rules: Sequence[Rule]) -> dict[str, Location]:
    """Return the weights of a network by their names in a naming."""
    want = weight_shapes(config)
    return {
        rule.source.replace("*", str(layer)): Location(rule.target, layer, rule)
        for rule in rules
        for layer in (range(want[rule.target][0]) if rule.stacked else (None,))
    }


def parse(key: str, known: Mapping[str, Location]) -> Name | None:
    """Return the parts of the name of a tensor, or None if no layer of the network has it."""
    suffix = SUFFIX.search(key)
    if suffix is None:
        layer, end, role, adapter = SAVED.sub("", key), "", "value", None
    else:
        layer, adapter = key[: suffix.start()], suffix[2]
        end, role = FULL.get(suffix[1], "weight"), LOW_RANK.get(suffix[1], suffix[1])
    for start in (0, *(dot.end() for dot in re.finditer(r"\.", layer))):
        if re.search(r"(^|\.)\d+\.", layer[:start]):
            return None  # in a block of another stack
        rest = layer[start:]
        while rest:
            if (location := known.get(_plain(f"{rest}.{end}".rstrip(".")))) is not None:
                prefix = layer[: len(layer) - len(rest)]
                return Name(key, prefix, _plain(rest), location, role, adapter)
            more = next((p for p in KOHYA if rest.startswith(p)), "")
            rest = rest.removeprefix(more) if more else ""
    return None


def refuse_others(keys: Iterable[str], *, source: str, fix: str) -> None:
    """Raise `InputError` if tensors are of another kind of adapter than LoRA."""
    for key in keys:
        for kind, pattern in OTHER.items():
            if pattern.search(key):
                raise InputError(
                    f"{source} has tensors of {kind}, such as {quote(key)}: only plain LoRA is "
                    f"read. {fix}"
                )


def chosen(
    names: Sequence[Name], *, source: str, prefix: str | None, adapter: str | None
) -> list[Name]:
    """Return the names of one adapter, after one prefix if given.

    Raises `InputError` naming the prefixes or adapters if there are several.
    """
    if prefix is not None:
        wanted = prefix.rstrip(".")
        within = [n for n in names if f"{n.prefix}.".startswith(f"{wanted}.") or not wanted]
        if not within:
            raise InputError(
                f"{source} has no layers of this network after {quote(prefix)}. Its prefixes: "
                f"{_listed(n.prefix for n in names)}. (--prefix)"
            )
        names = within
    prefixes, targets = {name.prefix for name in names}, {}
    for name in names:
        targets.setdefault((name.location, name.role, name.adapter), set()).add(name.prefix)
    twice = any(len(found) > 1 for found in targets.values())
    if len(prefixes) > 1 and (twice or not all(map(_is_common, prefixes))):
        raise InputError(
            f"{source} has layers of this network after several prefixes, "
            f"{_listed(prefixes)}: choose one. (egosim convert lora --prefix)"
        )
    adapters = {name.adapter or "default" for name in names if name.role in ("down", "up")}
    if adapter not in (None, *adapters) or (adapter is None and len(adapters) > 1):
        raise InputError(
            f"{source} has the adapters {_listed(adapters)}: choose one of them. (egosim convert "
            "lora --adapter)"
        )
    of_one = ("down", "up")
    return [
        n for n in names
        if adapter is None or n.role not in of_one or (n.adapter or "default") == adapter
    ]  # fmt: skip


def _listed(texts: Iterable[str]) -> str:
    return listing([quote(text) for text in sorted(set(texts))])


def _is_common(prefix: str) -> bool:
    """Return True for a prefix of the known projects, also several in a row."""
    while more := next((p for p in PREFIXES if prefix.startswith(p)), ""):
        prefix = prefix.removeprefix(more)
    return not prefix


def _plain(name: str) -> str:
    """Return a layer's name with underscores for dots, and without torch.compile's part."""
    return name.replace(".", "_").replace("_orig_mod_", "")
