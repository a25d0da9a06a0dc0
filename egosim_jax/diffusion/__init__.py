"""Flow matching: the path, its noise levels, the solvers, guidance and the training objective."""

from egosim_jax.diffusion.guidance import Guidance
from egosim_jax.diffusion.objective import Objective
from egosim_jax.diffusion.schedule import FlowSchedule, VelocityFn
from egosim_jax.diffusion.solver import Euler, Solver, UniPC, integrate

__all__ = [
    "Euler",
    "FlowSchedule",
    "Guidance",
    "Objective",
    "Solver",
    "UniPC",
    "VelocityFn",
    "integrate",
]
