"""Names and settings of LoRA files in other projects, in one table.

PEFT, diffusers, kohya, ComfyUI, VideoX-Fun, musubi, finetrainers, SimpleTuner, LightX2V and
FastVideo differ in a few words: prefix and suffix of a tensor's name, and the keys of alpha and
rank. A prefix is any text that ends with a dot, or the start of kohya's names, which have
underscores for dots. The layer after it has a name in one of the namings of the network's table.
PEFT's names can also have an adapter: `lora_A.NAME.weight`.

A setting that changes the meaning of the tensors is applied, or refused by its name. So is a
setting that is not listed: PEFT adds new ones.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io.bounded import listing, parse_json, quote, quote_path, quote_text, read_json
from egosim_jax.models import NetworkConfig
from egosim_jax.types import InputError

KOHYA = ("lora_unet_", "lora_transformer_", "lycoris_", "_")
"""Prefixes of names with underscores for dots."""
PREFIXES = (
    "base_model.model.", "diffusion_model.", "model.", "transformer.", "pipe.dit.", "dit.", *KOHYA,
)  # fmt: skip
"""Prefixes of other projects, which one LoRA can mix."""
COMMON = re.compile(rf"({'|'.join(map(re.escape, PREFIXES))})*")
TEXT = re.compile(r"(^|\.)(lora_te|text_encoders?\.)")
"""Prefixes of a text encoder's layers, which are skipped."""
ROLES = {
    "lora_A": "down", "lora_down": "down", "lora.down": "down", "lora_linear_layer.down": "down",
    "lora_B": "up", "lora_up": "up", "lora.up": "up", "lora_linear_layer.up": "up",
    "alpha": "alpha", "lora_alpha": "alpha", "diff": "diff", "diff_b": "diff", "diff_m": "diff",
}  # fmt: skip
"""Role of a tensor by the suffix of its name."""
FULL = {"diff": "weight", "diff_b": "bias", "diff_m": "modulation"}
"""Kind of weight of a full difference by the suffix of its name."""
SUFFIX = re.compile(
    rf"(?:\.|_(?=lora\.))({'|'.join(map(re.escape, ROLES))})(?:\.(?!weight$)([^.]+))?(\.weight)?$"
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

ADAPTER, ADAPTER_STEM = "adapter_config.json", "adapter_model"
"""File of PEFT's settings, and the stem of the weights that PEFT writes next to it."""
CONFIGS = ("lora_adapter_metadata", "lora_config", "adapter_config", "peft_config")
"""Header keys of settings in JSON: of diffusers and SimpleTuner, finetrainers, and others."""
PEFT_ALPHA = "lora_alpha"
"""The alpha that scales as it is; 0 of the other names is the rank, as kohya's trainers read it."""
KEYS = {
    "alpha": (PEFT_ALPHA, "network_alpha", "ss_network_alpha", "alpha"),
    "rank": ("r", "lora_rank"),
    "rank_stabilized": ("use_rslora", "rs_lora"),
}
"""Names of a setting in a config or a header."""
KOHYA_ARGS = "ss_network_args"
"""Header key of kohya with arguments in JSON; other JSON of kohya has image names and tags."""
STRENGTH = re.compile("alpha|rank|rs_?lora", re.IGNORECASE)
"""Header keys that may say the strength of a LoRA, so that none is passed over."""
HARMLESS = re.compile("dropout|mask|^conv_|^block_|^(ss_)?(network_)?rank$", re.IGNORECASE)
"""Header keys among them that are not for all layers: kohya's tensors have their own alpha."""
ALLOWED = {
    "peft_type": ("LORA",), "bias": (None, "none"),
    # All other starts also change the base weights (PiSSA).
    "init_lora_weights": (True, False, None, "gaussian", "orthogonal", "eva"),
}  # fmt: skip
"""Values of PEFT's settings that are applied by doing nothing; of others they are empty."""
NEUTRAL = {
    "_custom_modules", "auto_mapping", "base_model_name_or_path", "corda_config",
    "ensure_weight_tying", "ephemeral_gpu_offload", "eva_config", "exclude_modules",
    "inference_mode", "layers_pattern", "layers_to_transform", "loftq_config", "lora_dropout",
    "lora_ga_config", "megatron_core", "peft_version", "qalora_group_size", "revision",
    "runtime_config", "task_type",
}  # fmt: skip
"""Keys of PEFT that say how a LoRA was trained, not what its tensors mean."""
LISTED = {"alpha_pattern", "modules_to_save", "rank_pattern", "target_modules"}
"""Keys of PEFT that are read besides `KEYS`."""
MERGE = (
    "Merge the adapter into its base in the project that trained it (PEFT: merge_and_unload), and "
    "convert the merged weights. (egosim convert weights)"
)
"""Fix of what this package cannot apply."""


@dataclass(frozen=True)
class Location:
    """A weight, or one layer of a stacked weight."""

    target: str
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
    prefix: str
    """Text before the name of the layer."""
    layer: str
    """Name of the layer, with underscores for dots; of the weight, if the role is `value`."""
    location: Location
    """Weight that the tensor changes."""
    role: str
    """A value of `ROLES`, or `value` for a weight in full."""
    adapter: str | None


def locations(config: NetworkConfig) -> dict[str, Location]:
    """Return the weights by their plain names in all namings; earlier namings take precedence."""
    by_name: dict[str, Location] = {}
    for naming in table_of(config).namings.values():
        named = locations_by_name(config, naming.rules(config))
        by_name = {_plain(name): location for name, location in named.items()} | by_name
    return by_name


def locations_by_name(config: NetworkConfig, rules: Sequence[Rule]) -> dict[str, Location]:
    """Return the weights of a network by their names in a naming."""
    want = weight_shapes(config)
    return {
        rule.source.replace("*", str(layer)): Location(rule.target, layer, rule)
        for rule in rules
        for layer in (range(want[rule.target][0]) if rule.stacked else (None,))
    }


def parse(key: str, by_name: Mapping[str, Location]) -> Name | None:
    """Return the parts of the name of a tensor, or None if no layer of the network has it."""
    layer, end, role, adapter = SAVED.sub("", key), "", "value", None
    if suffix := SUFFIX.search(key):
        layer, adapter = key[: suffix.start()], suffix[2]
        end, role = f".{FULL.get(suffix[1], 'weight')}", ROLES[suffix[1]]
    for start in (0, *(dot.end() for dot in re.finditer(r"\.", layer))):
        if re.search(r"(^|\.)\d+\.", layer[:start]):
            return None  # in a block of another stack
        rest = layer[start:]
        while rest:
            if (location := by_name.get(_plain(f"{rest}{end}"))) is not None:
                prefix = layer[: len(layer) - len(rest)]
                return Name(key, prefix, _plain(rest), location, role, adapter)
            more = next((p for p in KOHYA if rest.startswith(p)), "")
            rest = rest.removeprefix(more) if more else ""
    return None


def refuse_others(keys: Iterable[str], *, source: str) -> None:
    """Raise `InputError` if tensors are of another kind of adapter than LoRA."""
    for key, (kind, names) in ((key, other) for key in keys for other in OTHERS.items()):
        if re.search(rf"(?:^|\.)(?:{names})(?:\.|$)", key):
            raise InputError(
                f"{source} has tensors of {kind}, such as {quote(key)}: only plain LoRA is read. "
                f"{MERGE}"
            )


def chosen(
    names: Sequence[Name], *, source: str, prefix: str | None, adapter: str | None
) -> list[Name]:
    """Return the names of one adapter, after one prefix if given.

    Raises `InputError` naming the prefixes or adapters if there are several.
    """
    if prefix is not None:
        wanted, every = prefix.rstrip("."), names
        names = [n for n in every if f"{n.prefix}.".startswith(f"{wanted}.") or not wanted]
        if not names:
            raise InputError(
                f"{source} has no layers of this network after {quote(prefix)}. Its prefixes: "
                f"{_listed(n.prefix for n in every)}. (--prefix)"
            )
    prefixes = {name.prefix for name in names}
    twice = len({(n.location, n.role, n.adapter) for n in names}) < len(
        {(n.location, n.role, n.adapter, n.prefix) for n in names}
    )
    if len(prefixes) > 1 and (twice or not all(map(COMMON.fullmatch, prefixes))):
        raise InputError(
            f"{source} has layers of this network after several prefixes, "
            f"{_listed(prefixes)}: choose one. (egosim convert lora --prefix)"
        )
    low_rank = [name for name in names if name.role in ("down", "up")]
    adapters = {name.adapter or "default" for name in low_rank}
    if adapter not in (None, *adapters) or (adapter is None and len(adapters) > 1):
        raise InputError(
            f"{source} has the adapters {_listed(adapters)}: choose one of them. (egosim convert "
            "lora --adapter)"
        )
    others = [n for n in low_rank if adapter not in (None, n.adapter or "default")]
    return [name for name in names if name not in others]


def _listed(texts: Iterable[str]) -> str:
    return listing([quote(text) for text in sorted(set(texts))])


def _plain(name: str) -> str:
    """Return a layer's name with underscores for dots, and without torch.compile's part."""
    return name.replace(".", "_").replace("_orig_mod_", "")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all layers of a LoRA."""

    source: str = ""
    """File or header that has them, for error messages."""
    alpha: float | None = None
    """Alpha of layers without one; None or 0: the rank."""
    exact: bool = False
    """True if no layer may have another alpha."""
    rank_stabilized: bool = False
    """True for a scale of alpha / sqrt(r), as in rsLoRA, instead of alpha / r."""
    ranks: frozenset[float] = frozenset()
    """Ranks that layers may have; empty if not said."""
    targets: tuple[str, ...] = ()
    """Ends of the names of the adapted layers; empty if not said as names."""
    saved: tuple[str, ...] = ()
    """Ends of the names of layers whose weights are in the file in full."""

    def scale(self, alpha: float | None, rank: int) -> float:
        """Return the factor of a low-rank product; alpha None or 0 is the rank."""
        return (alpha or rank) / (math.sqrt(rank) if self.rank_stabilized else rank)

    def misfit(self, layer: str, rank: int, alpha: float | None) -> str | None:
        """Return why a layer is not of the adapter with these settings, or None.

        `layer` is its name in the file, `alpha` the file's own.
        """
        if self.ranks and rank not in self.ranks:
            return f"{layer} has rank {rank}; expected {listing([f'{r:g}' for r in self.ranks])}"
        if self.targets and not _ends(layer, self.targets):
            return f"{layer} is not of its target_modules, {listing(self.targets)}"
        if self.exact and alpha not in (None, self.alpha):
            return f"{layer} has alpha {alpha:g}; expected {PEFT_ALPHA} {self.alpha:g}"
        return None

    def saves(self, weight: str) -> bool:
        """Return True if the settings say that a weight is in the file in full."""
        return _ends(weight.rpartition("_")[0], self.saved)


def _ends(layer: str, ends: Iterable[str]) -> bool:
    return any(f"_{_plain(layer)}".endswith(f"_{_plain(end)}") for end in ends)


def settings_of(path: Path, file: Path, metadata: Mapping[str, str]) -> Settings:
    """Read the settings of a LoRA file from the adapter's config next to it and from its header.

    `path` is the file or its folder. Raises `InputError` naming a setting that cannot be applied, a
    header key that may be one and is not understood, or two places that contradict each other.
    """
    configs, others = _places(path, file, metadata)
    for source, config in configs.items():
        _check(config, source)
    values: dict[str, tuple[float, str]] = {}
    for source, config in (configs | others).items():
        for setting, name, value in said(config, source):
            before, where = values.setdefault(setting, (value, f"{name} of {source}"))
            if before != value:
                raise InputError(
                    f"{where} is {before:g}, and {name} of {source} is {value:g}. Keep the one "
                    "that the LoRA was trained with."
                )
    (alpha, where), (rank, _) = (values.get(name, (None, "")) for name in ("alpha", "rank"))
    ranks, alphas = (_numbers(configs, key) for key in ("rank_pattern", "alpha_pattern"))
    if alphas - {alpha}:
        raise InputError(
            f"{next(iter(configs))} has an alpha_pattern, and here all layers have one lora_alpha. "
            f"{MERGE}"
        )
    return Settings(
        source=next(iter(configs | others)),
        alpha=alpha,
        exact=where.startswith(PEFT_ALPHA),
        rank_stabilized=values.get("rank_stabilized", (0, ""))[0] == 1,
        ranks=frozenset() if rank is None else frozenset({rank, *ranks}),
        targets=_names(configs, "target_modules"),
        saved=_names(configs, "modules_to_save"),
    )


def _places(
    path: Path, file: Path, metadata: Mapping[str, str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return PEFT's configs of a LoRA by their source, and the header with other JSON in it."""
    configs, others = {}, {f"the header of {quote_path(path)}": metadata}
    adapter = (path if path.is_dir() else path.parent) / ADAPTER
    if os.path.lexists(adapter):
        weights = [f for f in adapter.parent.glob(f"{ADAPTER_STEM}.*") if f.is_file()]
        if file.stem != ADAPTER_STEM and weights:
            raise InputError(
                f"{quote_path(adapter)} belongs to {quote_path(weights[0].name)}, not to "
                f"{quote_path(file.name)}: move one of the two LoRAs to another folder."
            )
        configs[quote_path(adapter)] = read_json(adapter)
    for key, text in metadata.items():
        source = f"{quote_text(key)} of {quote_path(path)}"
        if key in CONFIGS:
            config = parse_json(text.encode(), source=source)
            if isinstance(config, dict):  # of a pipeline: each key has its network before it
                named = {k.removeprefix("transformer."): v for k, v in config.items() if "." in k}
                config = {k: v for k, v in named.items() if "." not in k} or config
            configs[source] = config
        elif text.lstrip().startswith("{") and (key == KOHYA_ARGS or not key.startswith("ss_")):
            with suppress(InputError):  # a text, not JSON
                others[source] = parse_json(text.encode(), source=source)
    for source, place in others.items():
        for key in place.keys() - {*CONFIGS}.union(*KEYS.values()):
            if STRENGTH.search(key) and not HARMLESS.search(key) and place[key] is not None:
                raise InputError(
                    f"{source} has {quote(key)} {quote(place[key])}, which may be the strength of "
                    f"the LoRA and is not understood. Write it as {PEFT_ALPHA}, or: {MERGE}"
                )
    return configs, others


def said(config: Mapping[str, Any], source: str) -> Iterator[tuple[str, str, float]]:
    """Yield the settings of `KEYS` in a config, with their names there; a boolean is 1 or 0."""
    for setting, name in ((setting, name) for setting, names in KEYS.items() for name in names):
        if (value := config.get(name)) in (None, "None", ""):
            continue
        if setting == "rank_stabilized":
            value = {"true": 1, "false": 0}.get(str(value).lower(), value)
        number = finite(value, f"{name} of {source}")
        if name == PEFT_ALPHA and number == 0:
            raise InputError(
                f"{name} of {source} is 0: the LoRA would change nothing. Set the alpha that it "
                "was trained with."
            )
        yield setting, name, number


def _check(config: Any, source: str) -> None:
    """Raise `InputError` unless a config is one of PEFT that can be applied."""
    if not isinstance(config, dict) or all(config.get(n) is None for n in KEYS["alpha"]):
        raise InputError(f"{source} has no {PEFT_ALPHA}, which PEFT writes. Add it.")
    for key in sorted(config.keys() - LISTED.union(NEUTRAL, *KEYS.values()), key=str):
        value, allowed = config[key], ALLOWED.get(key, (None, False, "", 0, [], {}))
        if not any(value is one or value == one for one in allowed):
            raise InputError(
                f"{source} has {quote(key)} {quote(value)}, which may change the base weights or "
                f"the meaning of the adapter, and cannot be applied. {MERGE}"
            )


def _numbers(configs: Mapping[str, Any], key: str) -> set[float]:
    """Return the values of a pattern in PEFT's configs."""
    numbers: set[float] = set()
    for source, config in configs.items():
        if not isinstance(pattern := config.get(key) or {}, dict):
            raise InputError(f"{source} has {key} {quote(pattern)}, which is not a JSON object.")
        numbers |= {finite(value, f"{key} of {source}") for value in pattern.values()}
    return numbers


def _names(configs: Mapping[str, Any], key: str) -> tuple[str, ...]:
    """Return a list of names; empty for a pattern in one text, which is not evaluated."""
    names = (n for c in configs.values() if isinstance(c.get(key), list) for n in c[key])
    return tuple(name for name in names if isinstance(name, str))


def finite(value: Any, name: str) -> float:
    """Return a value as a finite number. Raises `InputError` if it is not one."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{name} is {quote(value)}, which is not a finite number.")
    return number
