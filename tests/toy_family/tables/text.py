"""Conversion table of the toy text encoder."""

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import Naming, Table
from tests.toy_family.networks import ToyTextConfig


def rules(config: ToyTextConfig) -> list[Rule]:
    return [Rule("tokens.weight", "embed.embedding")]


TABLE = Table(
    namings={"toy": Naming(rules=rules, signature="tokens.weight", layout="toy", stem="text")}
)
