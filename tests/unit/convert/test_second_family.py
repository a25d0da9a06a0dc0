"""A family outside the package brings its own conversion table, named by its config."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file, save_file

from egosim_jax import configs
from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.detect import detect
from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import Naming, Table, weight_shapes
from egosim_jax.io import weights
from egosim_jax.models import abstract
from egosim_jax.models.layers import Linear, stack
from tests.translation import translate_back


@dataclass(frozen=True, kw_only=True)
class MixerConfig:
    """Config of a denoiser of linear layers."""

    table: ClassVar[str] = __name__
    in_channels: int = 49
    dim: int = 8
    layers: int = 2
    dtype: str = "float32"

    def build(self, *, rngs):
        return Mixer(self, rngs=rngs)


class Mixer(nnx.Module):
    """Denoiser of linear layers."""

    def __init__(self, config, *, rngs):
        axes = ("embed", "mlp")
        self.reader = Linear(config.in_channels, config.dim, axes=axes, rngs=rngs)
        self.blocks = stack(
            lambda rngs: Linear(config.dim, config.dim, axes=axes, rngs=rngs),
            config.layers, rngs=rngs,
        )  # fmt: skip

    def __call__(self, x):
        return self.reader(x)


def mixer_rules(config):
    return [
        Rule("in_proj.weight", "reader.kernel", "linear"),
        Rule("in_proj.bias", "reader.bias"),
        Rule("layers.*.mix.weight", "blocks.kernel", "linear"),
        Rule("layers.*.mix.bias", "blocks.bias"),
    ]


LAYOUT = ChannelLayout(
    parts=(("noisy", 16), ("hands", 16), ("mask", 1), ("prior", 16)),
    mask_packing="single", mask_one="keep", mask_scale=0.7, mask_prior=False,
)  # fmt: skip
BASE = replace(
    LAYOUT, parts=(("noisy", 16), ("prior", 16), ("mask", 1)), mask_one="generate", mask_scale=1.0
)
TABLE = Table(
    namings={
        "mixer": Naming(
            rules=mixer_rules, signature="layers.0.mix.weight", layout="mixer",
            folder="denoiser", stem="mixer", lora_prefix="mixer.",
        )
    },
    base=BASE,
    input_layer="reader",
)  # fmt: skip
CONFIG = MixerConfig()
MODEL = SimpleNamespace(
    name="mixer", dit=CONFIG, networks={"dit": CONFIG}, layout=LAYOUT,
    tokenizer=SimpleNamespace(kind="byt5"),
    chunks=None,
)  # fmt: skip


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(configs, "names", lambda: ["mixer"])
    monkeypatch.setattr(configs, "get", lambda name: MODEL)


def foreign(config=CONFIG):
    rng = np.random.default_rng(0)
    values = {
        path: rng.normal(size=shape).astype(np.float32)
        for path, shape in weight_shapes(config).items()
    }
    tensors = translate_back(values, mixer_rules(config))
    return {f"net.{name}": np.ascontiguousarray(tensor) for name, tensor in tensors.items()}


def run(*args):
    return main([str(arg) for arg in args])


def test_a_checkpoint_is_detected_converted_verified_and_written_back(tmp_path, capsys):
    save_file(foreign(), tmp_path / "x.safetensors")
    (found,) = detect(tmp_path / "x.safetensors").found
    assert (found.network, found.naming, found.prefix) == ("dit", "mixer", "net.")
    assert run("inspect", tmp_path / "x.safetensors") == 0
    assert "missing networks: none" in capsys.readouterr().out
    convert = ["weights", tmp_path / "x.safetensors", "--config", "mixer"]
    assert run(*convert, "--out", tmp_path / "out") == 0
    verify = ["verify", tmp_path / "x.safetensors", tmp_path / "out", "--config", "mixer"]
    assert run(*verify) == 0
    assert "its table has no reference" in capsys.readouterr().out
    back = ["to-torch", tmp_path / "out", "--config", "mixer", "--out", tmp_path / "back"]
    assert run(*back, "--layout", "mixer") == 0
    written = load_file(tmp_path / "back" / "denoiser" / "mixer.safetensors")
    expected = {name.removeprefix("net."): tensor for name, tensor in foreign().items()}
    assert written.keys() == expected.keys()
    assert all(np.array_equal(written[name], expected[name]) for name in expected)
    assert run(*back, "--layout", "wan") == 2
    assert "Available: mixer. (--layout)" in capsys.readouterr().err


def test_a_base_model_is_widened_by_the_two_layouts(tmp_path):
    """The base has the parts in another order, and its mask is 1 = generate, without a factor."""
    narrow = replace(CONFIG, in_channels=BASE.channels)
    tensors = foreign(narrow)
    save_file(tensors, tmp_path / "base.safetensors")
    args = ["weights", tmp_path / "base.safetensors", "--config", "mixer"]
    assert run(*args, "--out", tmp_path / "out", "--widen", "polarity") == 0
    network = abstract(CONFIG)
    weights.load(tmp_path / "out" / "dit.safetensors", network)
    rng = np.random.default_rng(1)
    noisy, prior, hands = rng.normal(size=(3, 5, 16))
    generate = rng.integers(0, 2, (5, 1))
    base = np.concatenate([noisy, prior, generate], axis=-1)
    ours = np.concatenate([noisy, hands, 0.7 * (1 - generate), prior], axis=-1)
    expected = base @ tensors["net.in_proj.weight"].T + tensors["net.in_proj.bias"]
    np.testing.assert_allclose(network(jnp.array(ours, jnp.float32)), expected, atol=1e-5)
    assert run(*args, "--out", tmp_path / "none") == 2
    verify = ["verify", tmp_path / "base.safetensors", tmp_path / "out", "--config", "mixer"]
    assert run(*verify, "--widen", "polarity") == 0
    assert run(*verify, "--widen", "copy") == 1


def test_a_lora_is_read_merged_and_written_in_the_naming_of_the_table(tmp_path):
    rng = np.random.default_rng(2)
    tensors = {
        "mixer.layers.1.mix.lora_A.weight": rng.normal(size=(3, 8)).astype(np.float32),
        "mixer.layers.1.mix.lora_B.weight": rng.normal(size=(8, 3)).astype(np.float32),
        "mixer.in_proj.diff": rng.normal(size=(8, 49)).astype(np.float32),
    }
    save_file(foreign(), tmp_path / "x.safetensors")
    save_file(tensors, tmp_path / "lora.safetensors")
    args = ["--config", "mixer", "--out"]
    assert run("weights", tmp_path / "x.safetensors", *args, tmp_path / "base") == 0
    read = ["lora", tmp_path / "lora.safetensors", *args]
    assert run(*read, tmp_path / "out" / "lora.safetensors") == 0
    written = load_file(tmp_path / "out" / "lora.safetensors")
    assert all(np.array_equal(written[name], tensors[name]) for name in tensors)
    assert run(*read, tmp_path / "merged", "--merge", tmp_path / "base") == 0
    before, after = (
        load_file(tmp_path / folder / "dit.safetensors") for folder in ("base", "merged")
    )
    down, up = (tensors[f"mixer.layers.1.mix.lora_{end}.weight"] for end in "AB")
    expected = before["blocks.kernel"] + np.stack([np.zeros((8, 8)), (up @ down).T])
    np.testing.assert_allclose(after["blocks.kernel"], expected, atol=1e-5)
    np.testing.assert_allclose(
        after["reader.kernel"], before["reader.kernel"] + tensors["mixer.in_proj.diff"].T, atol=1e-6
    )
