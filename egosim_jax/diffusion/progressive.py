"""Early steps on half the rows and columns of the latent grid.

At high noise a network lays out the scene, and a coarse grid is enough: it has a quarter of the
tokens. On the straight path x_t = (1 - t) x0 + t e, with e ~ N(0, 1), the mean over blocks
of 2 x 2 cells halves the deviation of the noise:

    mean x_t = (1 - t) mean x0 + (t / 2) e',   e' = 2 mean e ~ N(0, 1)

Divided by 1 - t / 2, these latents lie on the straight path of the half grid, at the time

    t' = t / (2 - t)

The rule t = 2 t' / (1 + t') shifts the noise levels of a grid to one of four times the cells (Esser
et al. 2024, section 5.3.2). The steps on the half grid visit these times. Their last latents x'
become latents of the whole grid with the detail of the noise e that the clip starts with:

    x_t = (1 - t / 2) repeat(x') + t (e - repeat(mean e))

Both grids so share their noise, and the means of x_t are again the latents of the half grid. The
noise of x_t has the variance t^2 (1/4 + 3/4). The solver starts again there, with no memory of the
half grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import SupportsIndex

import jax.numpy as jnp
import numpy as np
from einops import reduce, repeat
from jaxtyping import Array, Float

from egosim_jax.diffusion.caching import StepCache
from egosim_jax.diffusion.process import DenoiseFn, Process, RectifiedFlow
from egosim_jax.diffusion.solver import Solver, integrate
from egosim_jax.types import InputError

HALF = 2
"""Side of a cell of the half grid, in cells of the whole grid."""


@dataclass(frozen=True, kw_only=True)
class Progressive:
    """Steps on half the grid, before the others; off means exact."""

    share: float
    """Share of the steps that run on half the rows and columns, the noisiest first."""

    def __post_init__(self) -> None:
        if not 0 < self.share < 1:
            raise InputError(
                f"{self.share:g} is no share of steps on half the grid: it must be above 0 and "
                "below 1. Omit it, to run all steps on the whole grid. (--progressive)"
            )

    def count(self, steps: int) -> int:
        """Return how many of the steps run on half the grid."""
        return round(self.share * steps)

    def check(
        self, process: Process, solver: Solver, steps: int, cells: Sequence[int], patch: int
    ) -> None:
        """Raise `InputError` unless a model allows it, by its sampler and its grid.

        `cells` are the rows and columns of the latents; a token has `patch` of both.
        """
        if not isinstance(process, RectifiedFlow):
            raise InputError(
                "Steps on half the grid need a rectified flow, whose noise levels are continuous, "
                f"not {type(process).__name__}: omit them. (--progressive)"
            )
        if solver.stochastic:
            raise InputError(
                f"{type(solver).__name__} adds noise at its steps, which the two grids would not "
                "share. Choose another solver, or omit the steps on half the grid. "
                "(--progressive, --solver)"
            )
        if not 0 < self.count(steps) < steps:
            raise InputError(
                f"A share of {self.share:g} of {steps} steps is {self.count(steps)}, but each of "
                "the two grids needs at least one step. (--progressive, --steps)"
            )
        unit = HALF * patch
        if any(size % unit for size in cells):
            raise InputError(
                f"The latents of {cells[0]} x {cells[1]} cells have no half grid: rows and columns "
                f"must be multiples of {unit}, which half of a grid of {patch} x {patch} cells a "
                "token needs. Omit the steps on half the grid. (--progressive)"
            )


def means(x: Float[Array, "b f h w c"]) -> Float[Array, "b f i j c"]:
    """Return the mean of each block of 2 x 2 cells."""
    return reduce(x, "b f (i y) (j x) c -> b f i j c", "mean", y=HALF, x=HALF)


def repeated(x: Float[Array, "b f i j c"]) -> Float[Array, "b f h w c"]:
    """Return the whole grid in which each block of 2 x 2 cells has one value."""
    return repeat(x, "b f i j c -> b f (i y) (j x) c", y=HALF, x=HALF)


def half_times(times: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """Return the times on the half grid at which its signal-to-noise ratio is the whole grid's."""
    return times / (2 - times)


def refined(
    x: Float[Array, "b f i j c"], noise: Float[Array, "b f h w c"], time: float
) -> Float[Array, "b f h w c"]:
    """Return latents of the whole grid at a time, from the half grid's and the initial noise."""
    return (1 - time / 2) * repeated(x) + time * (noise - repeated(means(noise)))


def integrate_progressively(
    on_half: DenoiseFn,
    on_whole: DenoiseFn,
    start: Float[Array, "b f h w c"],
    noise: Float[Array, "b f h w c"],
    *,
    progressive: Progressive,
    process: Process,
    solver: Solver,
    steps: SupportsIndex | Sequence[int | float],
    cache: StepCache | None = None,
) -> Float[Array, "b f h w c"]:
    """Turn noise into latents as `integrate` does, with the first steps on half the grid.

    `start` are the latents at the first time: the noise, or data with this noise. A cache forgets
    its predictions between the grids.
    """
    times = process.times(steps)
    count = progressive.count(len(times) - 1)
    sampler = {"process": process, "solver": solver, "cache": cache}
    halved, whole = (
        process.exact_timesteps(visited).tolist()
        for visited in (half_times(times[:-1]), times[count:-1])
    )
    x = means(start.astype(jnp.float32)) / (1 - float(times[0]) / 2)
    x = integrate(on_half, x, steps=halved, count=count, **sampler)
    x = refined(x, noise.astype(jnp.float32), float(times[count]))
    return integrate(on_whole, x, steps=whole, **sampler)
