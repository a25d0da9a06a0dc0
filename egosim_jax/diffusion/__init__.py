"""Diffusion: processes from data to noise, solvers, guidance and the training objective.

Pure functions of arrays and a predicting function belong here. Networks do not.

    RectifiedFlow, VariancePreserving       processes
    Euler, DDIM, Renoise, UniPC, DPMSolver  solvers
    SOLVERS                                 solvers by name, also of other packages
    integrate                               the sampling loop, one scan
    StepCache                               steps that reuse predictions
    Progressive                             early steps on half the latent grid
    Guidance                                classifier-free guidance
    Objective                               training loss at random noise levels
"""

from egosim_jax.diffusion.caching import StepCache
from egosim_jax.diffusion.dpm import DPMSolver
from egosim_jax.diffusion.guidance import Guidance
from egosim_jax.diffusion.objective import Objective
from egosim_jax.diffusion.process import (
    DenoiseFn,
    Prediction,
    Process,
    RectifiedFlow,
    VariancePreserving,
)
from egosim_jax.diffusion.progressive import Progressive
from egosim_jax.diffusion.solver import DDIM, SOLVERS, Euler, Renoise, Solver, integrate
from egosim_jax.diffusion.unipc import UniPC

__all__ = [
    "DDIM",
    "SOLVERS",
    "DPMSolver",
    "DenoiseFn",
    "Euler",
    "Guidance",
    "Objective",
    "Prediction",
    "Process",
    "Progressive",
    "RectifiedFlow",
    "Renoise",
    "Solver",
    "StepCache",
    "UniPC",
    "VariancePreserving",
    "integrate",
]
