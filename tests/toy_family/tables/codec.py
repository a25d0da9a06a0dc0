"""Conversion table of the toy codec."""

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import Naming, Table
from tests.toy_family.networks import ToyCodecConfig


def rules(config: ToyCodecConfig) -> list[Rule]:
    found = []
    for theirs, ours in {"encoder": "down", "decoder": "up"}.items():
        found += [
            Rule(f"{theirs}.weight", f"{ours}.kernel", "linear"),
            Rule(f"{theirs}.bias", f"{ours}.bias"),
        ]
    return found


TABLE = Table(
    namings={"toy": Naming(rules=rules, signature="encoder.weight", layout="toy", stem="codec")}
)
