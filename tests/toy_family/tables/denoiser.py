"""Conversion table of the toy denoiser."""

from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import Naming, Table
from tests.toy_family.networks import ToyDenoiserConfig

BASE = ChannelLayout(
    parts=(("noisy", 6), ("mask", 1), ("prior", 6)),
    mask_packing="single",
    mask_one="keep",
    mask_scale=0.7,
    mask_prior=False,
)


def rules(config: ToyDenoiserConfig) -> list[Rule]:
    layers = {"proj_in": "input", "context": "text", "proj_out": "output"}
    found = []
    for i in range(config.layers):
        layers |= {f"layer.{i}.fc1": f"blocks.{i}.up", f"layer.{i}.fc2": f"blocks.{i}.down"}
        found += [
            Rule(f"layer.{i}.ln.weight", f"blocks.{i}.norm.scale"),
            Rule(f"layer.{i}.ln.bias", f"blocks.{i}.norm.bias"),
        ]
    for theirs, ours in layers.items():
        found += [
            Rule(f"{theirs}.weight", f"{ours}.kernel", "linear"),
            Rule(f"{theirs}.bias", f"{ours}.bias"),
        ]
    return found


TABLE = Table(
    namings={
        "toy": Naming(rules=rules, signature="layer.0.fc1.weight", layout="toy", stem="denoiser")
    },
    base=BASE,
    input_layer="input",
)
