"""One short file for each model that can be trained, each a plan that reads from top to bottom."""

from egosim_jax.train.recipes.debug import Debug
from egosim_jax.train.recipes.egosim_1_3b import Egosim1B
from egosim_jax.train.recipes.egosim_14b import Egosim14B
from egosim_jax.train.recipes.egosim_14b_fewshot import Egosim14BFewshot
from egosim_jax.train.recipes.egosim_14b_lora import Egosim14BLora
from egosim_jax.train.recipes.egosim_14b_robot import Egosim14BRobot
from egosim_jax.train.recipes.real_tiny import RealTiny
from egosim_jax.train.recipes.tabletop import Tabletop

__all__ = [
    "Debug",
    "Egosim1B",
    "Egosim14B",
    "Egosim14BFewshot",
    "Egosim14BLora",
    "Egosim14BRobot",
    "RealTiny",
    "Tabletop",
]
