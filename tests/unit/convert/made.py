"""Small checkpoints and LoRAs, and commands that must fail with a one-line error."""

import json
from functools import cache

import numpy as np
import torch
from safetensors.torch import save_file

from egosim_jax import configs
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io import weights
from tests.translation import translate_back

CONFIG = configs.get("debug")
DIM = CONFIG.dit.dim
NAME = "diffusion_model.blocks.0.self_attn.q"
LAYER = "blocks.self_attn.q"


def one_line(capsys, code, *args):
    assert main([str(arg) for arg in args]) == code
    said = capsys.readouterr().err.strip().splitlines()
    errors = [line for line in said if line.startswith("error: ")]
    assert len(errors) == 1
    assert "Traceback" not in "".join(said)
    return errors[0]


@cache
def arrays(network):
    rng = np.random.default_rng(0)
    found = weight_shapes(CONFIG.networks[network])
    return {path: 0.2 * rng.normal(size=s).astype(np.float32) for path, s in found.items()}


def foreign(network="dit", naming="wan", *, add=0.0, dtype=torch.float32):
    """The tensors of a network in foreign names; `add` makes other values."""
    rules = table_of(CONFIG.networks[network]).rules(naming, CONFIG.networks[network])
    values = {path: array + np.float32(add) for path, array in arrays(network).items()}
    return {
        name: torch.from_numpy(np.ascontiguousarray(array)).to(dtype)
        for name, array in translate_back(values, rules).items()
    }


def prefixed(tensors, prefix):
    return {f"{prefix}{name}": tensor for name, tensor in tensors.items()}


def sharded(folder, tensors, stem, shards=3):
    """Write tensors to several files with an index, like the Wan releases; return the index."""
    names = sorted(tensors)
    places = {
        name: f"{stem}-{1 + number % shards:05d}-of-{shards:05d}.safetensors"
        for number, name in enumerate(names)
    }
    for place in set(places.values()):
        save_file({n: tensors[n] for n in names if places[n] == place}, folder / place)
    index = folder / f"{stem}.safetensors.index.json"
    index.write_text(json.dumps({"metadata": {}, "weight_map": places}), encoding="utf-8")
    return index


def ours(folder, *networks):
    for network in networks:
        weights.write(
            folder / f"{network}.safetensors", arrays(network), metadata={"config": "debug"}
        )
    return folder


def theirs(tmp_path, network="text"):
    """A checkpoint of one network in its folder."""
    ours(tmp_path / "made", network)
    args = ["to-torch", tmp_path / "made", "--config", "debug", "--only", network]
    assert main([str(a) for a in [*args, "--out", tmp_path / "theirs"]]) == 0
    return tmp_path / "theirs"


def pair(rank=2, dim=DIM, name=NAME):
    torch.manual_seed(0)
    return {
        f"{name}.lora_A.weight": torch.randn(rank, dim),
        f"{name}.lora_B.weight": torch.randn(dim, rank),
    }


def save(path, tensors, about=None):
    save_file(tensors, path, about)
    return path
