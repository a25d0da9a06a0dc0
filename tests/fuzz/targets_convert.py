"""The formats that the weight converter reads."""

from __future__ import annotations

import json
import pickle
import random
import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax import configs
from egosim_jax.convert.lora import read_lora
from egosim_jax.convert.lora_table import ADAPTER
from egosim_jax.convert.source import sources
from egosim_jax.io import weights
from egosim_jax.io.digest import sha256
from egosim_jax.io.mapped import CODES, Tensor, read_safetensors
from egosim_jax.io.untrusted.pickled_arrays import read_pickled_arrays
from egosim_jax.models.lora import Delta
from tests.fuzz.target import Mutate, Target

CONFIG = configs.get("debug")
NUMBERS = (0, 1, 2, 7, 8, 2**31 - 1, 2**32 - 1, 2**32, 2**62, 2**63, 2**64 - 1)
NAME = "diffusion_model.blocks.0.self_attn.q"


# Samples: the same at every call, of a few kB.


def tensors() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "blocks.0.w": rng.normal(size=(3, 5)).astype(np.float32),
        "blocks.1.w": rng.normal(size=(4,)).astype(np.float16),
        "ids": rng.integers(0, 9, (2, 2)),
        "none": np.zeros((0, 3), np.float32),
        "one": np.array(1.5),
    }


def lora_pair() -> dict[str, np.ndarray]:
    rng, dim = np.random.default_rng(0), CONFIG.dit.dim
    return {
        f"{NAME}.lora_A.weight": rng.normal(size=(2, dim)).astype(np.float32),
        f"{NAME}.lora_B.weight": rng.normal(size=(dim, 2)).astype(np.float32),
    }


def save(path: Path, arrays: Mapping[str, np.ndarray], about: dict[str, str]) -> None:
    from safetensors.numpy import save_file

    save_file(dict(arrays), path, about)


def make_pth(folder: Path) -> None:
    import torch

    arrays = {name: torch.from_numpy(array) for name, array in tensors().items()}
    whole = torch.arange(12.0).reshape(3, 4)
    tree = {"model": arrays, "views": [whole, whole.T], "epoch": 3, "name": "x", "rate": 0.5}
    torch.save(tree, folder / "x.pth")


def make_pickled(folder: Path) -> None:
    tree = {"a": tensors()["ids"], "b": {"c": tensors()["blocks.0.w"].T, "d": [tensors()["none"]]}}
    (folder / "x.pickle").write_bytes(pickle.dumps(tree, 3))


def make_foreign(folder: Path) -> None:
    save(folder / "x.safetensors", tensors(), {"format": "pt"})


def make_sealed(folder: Path) -> None:
    weights.write(folder / "x.safetensors", tensors(), metadata={"config": "debug"})


def make_sharded(folder: Path) -> None:
    names = sorted(tensors())
    files = {name: f"x-{1 + i % 2:05d}-of-00002.safetensors" for i, name in enumerate(names)}
    for file in sorted(set(files.values())):
        save(folder / file, {n: tensors()[n] for n in names if files[n] == file}, {})
    index = {"metadata": {"total_size": 0}, "weight_map": files}
    (folder / "x.safetensors.index.json").write_text(json.dumps(index), encoding="utf-8")


def make_lora(folder: Path) -> None:
    more = {
        f"{NAME}.alpha": np.array(4, np.float32),
        "lora_te_a.lora_down.weight": np.zeros((1, 1), np.float32),
        f"{NAME}.diff_b": np.ones(CONFIG.dit.dim, np.float32),
    }
    save(folder / "x.safetensors", lora_pair() | more, {"ss_network_alpha": "None"})


def make_peft(folder: Path) -> None:
    save(folder / "adapter_model.safetensors", lora_pair(), {"format": "pt"})
    said = {"peft_type": "LORA", "r": 2, "lora_alpha": 4, "use_rslora": True, "alpha_pattern": {}}
    (folder / ADAPTER).write_text(json.dumps(said), encoding="utf-8")


def make_folder(folder: Path) -> None:
    make_sharded(folder)
    make_pth(folder)


# Our readers.


def arrays_of(found: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: np.array(tensor.array()) for name, tensor in found.items()}


def read_folder(folder: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for source in sources(folder):
        found |= {f"{source.name}: {n}": a for n, a in arrays_of(source.tensors).items()}
    return found


def read_sealed(folder: Path) -> dict[str, np.ndarray]:
    return arrays_of(read_safetensors(folder / "x.safetensors"))


def read_pickled(folder: Path) -> dict[str, np.ndarray]:
    path = folder / "x.pickle"
    return read_pickled_arrays(path, sha256=sha256(path))


def read_one(name: str) -> Callable[[Path], dict[str, np.ndarray]]:
    def read(folder: Path) -> dict[str, np.ndarray]:
        (source,) = sources(folder / name)
        return arrays_of(source.tensors)

    return read


def read_changes(path: Path) -> dict[str, tuple[np.ndarray, ...]]:
    return {
        name: (change.down, change.up) if isinstance(change, Delta) else (change,)
        for name, change in read_lora(path, CONFIG.dit).items()
    }


# The readers of others.


def theirs_safetensors(folder: Path) -> dict[str, np.ndarray]:
    return their_arrays(folder / "x.safetensors")


def their_arrays(path: Path) -> dict[str, np.ndarray]:
    from safetensors.torch import load_file

    return {name: to_numpy(tensor) for name, tensor in load_file(path).items()}


def theirs_pth(folder: Path) -> dict[str, np.ndarray]:
    import torch

    tree = torch.load(folder / "x.pth", weights_only=True)
    found: dict[str, np.ndarray] = {}

    def walk(node: Any, name: str) -> None:
        if isinstance(node, torch.Tensor):
            found[name] = to_numpy(node)
        elif isinstance(node, (dict, list, tuple)):
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                walk(value, f"{name}.{key}" if name else str(key))

    walk(tree, "")
    return found


def to_numpy(tensor: Any) -> np.ndarray:
    """With its dtype, which NumPy by itself may not know."""
    import ml_dtypes
    import torch

    name = str(tensor.dtype).removeprefix("torch.")
    if hasattr(np, name):
        return tensor.detach().numpy()
    bits = {1: torch.uint8, 2: torch.int16}[tensor.element_size()]
    return tensor.detach().contiguous().view(bits).numpy().view(getattr(ml_dtypes, name))


# Changes that know the format.


def header_length(data: bytes, rng: random.Random) -> bytes:
    length = int.from_bytes(data[:8], "little")
    return struct.pack("<Q", (length + rng.choice((-8, -1, 1, 8))) % 2**64) + data[8:]


def header_number(data: bytes, rng: random.Random) -> bytes:
    return struct.pack("<Q", rng.choice(NUMBERS)) + data[8:]


def in_header(change: Callable[[dict[str, Any], random.Random], None]) -> Mutate:
    """A change of the header as JSON, whose length is then right."""

    def mutate(data: bytes, rng: random.Random) -> bytes:
        length = int.from_bytes(data[:8], "little")
        try:
            header = json.loads(data[8 : 8 + length])
            change(header, rng)
        except (ValueError, KeyError, IndexError, TypeError, AttributeError):
            return data[:-1]
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return mutate


def some(header: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    return header[rng.choice([name for name in header if name != "__metadata__"])]


def new_dtype(header: dict[str, Any], rng: random.Random) -> None:
    some(header, rng)["dtype"] = rng.choice([*CODES, "F4", "", None, [], {}, 1])


def new_offset(header: dict[str, Any], rng: random.Random) -> None:
    places = some(header, rng)["data_offsets"]
    at = rng.randrange(2)
    places[at] = rng.choice([*NUMBERS, places[at] + 1, places[at] - 4, -1, 1.0, None, "1"])


def new_shape(header: dict[str, Any], rng: random.Random) -> None:
    shape = some(header, rng)["shape"]
    match rng.randrange(4):
        case 0:
            shape.append(rng.choice([*NUMBERS, -1, 1.5, None]))
        case 1:
            shape.reverse()
        case 2:
            shape[rng.randrange(len(shape))] = rng.choice(NUMBERS)
        case _:
            shape += 70 * [1]


def new_name(header: dict[str, Any], rng: random.Random) -> None:
    name = rng.choice(list(header))
    new = rng.choice(
        [
            name[:-1],
            5000 * "n",
            "",
            "\ud800",
            "a\nb",
            "[/b].",
            "blocks.99999999999.w",
            "__metadata__",
        ]
    )
    header[new] = header.pop(name)


def swapped(header: dict[str, Any], rng: random.Random) -> None:
    first, second = some(header, rng), some(header, rng)
    first["data_offsets"], second["data_offsets"] = second["data_offsets"], first["data_offsets"]


def less(header: dict[str, Any], rng: random.Random) -> None:
    del header[rng.choice(list(header))]


def new_text(header: dict[str, Any], rng: random.Random) -> None:
    about = header["__metadata__"]
    about[rng.choice(list(about))] = rng.choice(["", "None", "nan", "1", "egosim_jax", 1, None, []])


SAFETENSORS: tuple[Mutate, ...] = (
    header_length,
    header_number,
    *map(in_header, (new_dtype, new_offset, new_shape, new_name, swapped, less, new_text)),
)


def json_value(data: bytes, rng: random.Random) -> bytes:
    """Another value for one of a JSON document's names or values."""
    places = [m.span() for m in re.finditer(rb'"[^"]*"|\b\d+\b|true|false|null|\{\}', data)]
    if not places:
        return data
    begin, end = rng.choice(places)
    values = (
        b"null", b"[]", b"{}", b"-1", b"1e999", b"NaN", b"true", b'""', b'"../x"', b'"\\ud800"',
        b'"\\u0000"', b"9" * 5000, b"[" * 3000, b'"' + b"a" * 5000 + b'"',
        b"1", b'"a"',
    )  # fmt: skip
    return data[:begin] + rng.choice(values) + data[end:]


def in_pickle(data: bytes) -> tuple[int, int]:
    start = re.search(rb"\x80[\x02-\x05]", data)
    begin = start.start() if start else 0
    return begin, max(data.find(b"PK", begin), begin + 1)


def opcode(data: bytes, rng: random.Random) -> bytes:
    """One byte of the pickle becomes an operation."""
    codes = [getattr(pickle, name) for name in dir(pickle) if name.isupper()]
    codes = [code for code in codes if isinstance(code, bytes) and len(code) == 1]
    at = rng.randrange(*in_pickle(data))
    return data[:at] + rng.choice(codes) + data[at + 1 :]


def pickled_number(data: bytes, rng: random.Random) -> bytes:
    """Four bytes of the pickle become a number."""
    at = rng.randrange(*in_pickle(data))
    return data[:at] + struct.pack("<I", rng.choice(NUMBERS) % 2**32) + data[at + 4 :]


def zip_number(data: bytes, rng: random.Random) -> bytes:
    """A number in one of the zip's records."""
    kind = rng.choice((b"PK\1\2", b"PK\3\4", b"PK\5\6", b"PK\6\6", b"PK\6\7"))
    places = [match.start() for match in re.finditer(re.escape(kind), data)]
    if not places:
        return data[:-1]
    at = rng.choice(places) + rng.randrange(4, 48)
    code = rng.choice(("<H", "<I", "<Q"))
    number = struct.pack(code, rng.choice(NUMBERS) % 2 ** (8 * struct.calcsize(code)))
    return data[:at] + number + data[at + len(number) :]


PTH: tuple[Mutate, ...] = (opcode, pickled_number, zip_number)
NO_CHECKSUM = "values, names and shapes of foreign files are as they say: they carry no checksum"

TARGETS: list[Target] = [
    Target(
        name="pth",
        make=make_pth,
        read=read_one("x.pth"),
        files=("x.pth",),
        reference=theirs_pth,
        mutations=PTH,
    ),
    Target(
        name="pickled-arrays",
        make=make_pickled,
        read=read_pickled,
        files=("x.pickle",),
        lossy="numbers of a pickle are as it says; the SHA-256 of the real file is known",
        mutations=(opcode, pickled_number),
    ),
    Target(
        name="safetensors",
        make=make_foreign,
        read=read_one("x.safetensors"),
        files=("x.safetensors",),
        reference=theirs_safetensors,
        mutations=SAFETENSORS,
    ),
    Target(
        name="sealed-weights",
        make=make_sealed,
        read=read_sealed,
        files=("x.safetensors",),
        sealed=True,
        mutations=SAFETENSORS,
    ),
    Target(
        name="weights-index",
        make=make_sharded,
        read=read_folder,
        files=("*.index.json",),
        lossy="without an index, numbered files are one checkpoint, too",
        mutations=(json_value,),
    ),
    Target(
        name="lora",
        make=make_lora,
        read=lambda folder: read_changes(folder / "x.safetensors"),
        files=("x.safetensors",),
        lossy=NO_CHECKSUM,
        mutations=SAFETENSORS,
    ),
    Target(
        name="peft",
        make=make_peft,
        read=read_changes,
        files=("*.safetensors", ADAPTER),
        lossy=NO_CHECKSUM,
        mutations=(*SAFETENSORS, json_value),
    ),
    Target(
        name="torch-folder",
        make=make_folder,
        read=read_folder,
        files=("*.safetensors", "*.json", "*.pth"),
        lossy=NO_CHECKSUM,
        mutations=(*SAFETENSORS, *PTH, json_value),
    ),
]
"""All of them."""
