"""One short file for each model that can be trained, each a plan that reads from top to bottom."""

from egosim_jax.train.recipes.debug import Debug
from egosim_jax.train.recipes.real_tiny import RealTiny
from egosim_jax.train.recipes.tabletop import Tabletop

__all__ = ["Debug", "RealTiny", "Tabletop"]
