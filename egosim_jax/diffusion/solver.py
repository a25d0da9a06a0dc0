"""Solvers of the sampling equation, from noise down to data, and the loop that runs them.

Our own code, because the samplers of other libraries keep state between calls and run step by step
from Python; here all steps are one compiled scan.

A solver's coefficients depend on the process and on the visited times alone. They are computed for
all steps on the host in float64, and the integration is one `lax.scan` over their rows
(`integrate`). Latents stay float32 between steps, whatever dtype the network computes in. DDIM and
DPM-Solver++ keep float64 latents if jax has float64 enabled.

Euler (rectified flow) follows the straight line of the present velocity v:

    x_t = x_s + (sigma_t - sigma_s) v

DDIM (Song et al. 2021; any process) keeps the predicted data and noise:

    x_t = alpha_t x0 + sqrt(sigma_t^2 - s^2) e + s n,   n ~ N(0, 1)
    s = eta sigma_t sqrt(1 - (alpha_s sigma_t / (sigma_s alpha_t))^2)

eta = 0 is deterministic, eta = 1 the ancestral sampler. The multistep solvers are in `unipc.py`
and `dpm.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, SupportsIndex, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from egosim_jax.diffusion.caching import StepCache
from egosim_jax.diffusion.process import DenoiseFn, Process, at_least_float32
from egosim_jax.runtime.registry import Registry
from egosim_jax.types import InputError

Kept = TypeVar("Kept")


@runtime_checkable
class Solver(Protocol):
    """A rule for the steps from noise to data; its state, a pytree, has the latents as `x`."""

    @property
    def stochastic(self) -> bool:
        """Return whether steps add noise, which needs a key."""
        ...

    def coefficients(self, process: Process, times: Float[np.ndarray, " times"]) -> Any:
        """Return every step's coefficients: arrays with a leading step axis.

        Raises `InputError` if the solver does not fit the process.
        """
        ...

    def start(self, x: Float[Array, "*x"]) -> Any:
        """Return the state before the first step, at the first time."""
        ...

    def step(
        self,
        process: Process,
        state: Any,
        output: Float[Array, "*x"],
        row: Any,
        keys: Key[Array, " b"] | None = None,
    ) -> Any:
        """Return the state after one step.

        `output` is the network's prediction at `state.x`, `row` the step's coefficients; `keys`
        draw the noise of each sample if the solver is stochastic.
        """
        ...


SOLVERS: Registry[Solver] = Registry(
    "solver",
    "--solver",
    "egosim_jax.solvers",
    {
        "euler": "egosim_jax.diffusion:Euler",
        "unipc": "egosim_jax.diffusion:UniPC",
        "wan": "egosim_jax.diffusion:UniPC",
        "ddim": "egosim_jax.diffusion:DDIM",
        "renoise": "egosim_jax.diffusion:Renoise",
        "dpmpp_2m": "egosim_jax.diffusion:DPMSolver",
        "dpmpp_2m_sde": "egosim_jax.diffusion.dpm:SDE",
    },
)
"""Solvers by name; `wan` also changes the process (`RectifiedFlow.wan_unipc`)."""


def sample_noise(keys: Key[Array, " b"], x: Float[Array, "*x"]) -> Float[Array, "*x"]:
    """Draw the noise of a step, each sample's from its own key."""
    return jax.vmap(lambda key: jax.random.normal(key, x.shape[1:]))(keys)


def integrate(
    denoise: DenoiseFn,
    noise: Float[Array, "b f h w c"],
    *,
    process: Process,
    solver: Solver,
    steps: SupportsIndex | Sequence[int | float],
    keys: Key[Array, " b"] | None = None,
    count: int | None = None,
    cache: StepCache | None = None,
) -> Float[Array, "b f h w c"]:
    """Turn noise into latents, one network evaluation a step: one scan, no host round trips.

    `steps` is the number of steps, or the timesteps to visit. `keys`, one for each sample, draw the
    noise of a stochastic solver; step i uses `fold_in(key, i)`. With `count`, only so many of the
    steps are taken. With a `cache`, steps reuse predictions.
    """
    rows = jax.tree.map(lambda row: row[:count], _rows(process, solver, steps, keys))
    if cache is None:

        def advance(state: Any, row: tuple) -> tuple[Any, None]:
            return _advance(lambda x, t: (denoise(x, t), None), process, solver, state, row)

        return jax.lax.scan(advance, solver.start(noise), rows)[0].x

    def advance_reusing(carry: Any, row: tuple) -> tuple[Any, None]:
        (state, memory), (due, row) = carry, row
        predict = lambda x, t: cache.predict(denoise, memory, x, t, due)  # noqa: E731
        return _advance(predict, process, solver, state, row), None

    start = solver.start(noise), cache.start(noise)
    rows = cache.due(len(rows[0])), rows
    return jax.lax.scan(advance_reusing, start, rows)[0][0].x


def integrate_keeping(
    denoise: Callable[[jax.Array, jax.Array], tuple[jax.Array, Kept]],
    noise: Float[Array, "b f h w c"],
    *,
    process: Process,
    solver: Solver,
    steps: SupportsIndex | Sequence[int | float],
    keys: Key[Array, " b"] | None = None,
) -> tuple[Float[Array, "b f h w c"], Kept]:
    """Return the latents, as `integrate` does, and the second result of the last evaluation."""
    rows = jax.tree.map(jnp.asarray, _rows(process, solver, steps, keys))
    before, last = jax.tree.map(lambda x: x[:-1], rows), jax.tree.map(lambda x: x[-1], rows)

    def advance(state: Any, row: tuple) -> tuple[Any, None]:
        return _advance(denoise, process, solver, state, row)[0], None

    state, _ = jax.lax.scan(advance, solver.start(noise), before)
    state, kept = _advance(denoise, process, solver, state, last)
    return state.x, kept


class Visited(NamedTuple):
    """Latents before each step of a solver, and what the network returned for them."""

    latents: Float[Array, "s b f h w c"]
    """Input of each step."""
    outputs: Float[Array, "s b f h w c"]
    """Prediction of each step."""
    timesteps: Float[Array, " s"]
    """Timestep of each step."""


def integrate_visiting(
    denoise: Callable[[jax.Array, jax.Array], tuple[jax.Array, Kept]],
    noise: Float[Array, "b f h w c"],
    *,
    process: Process,
    solver: Solver,
    steps: SupportsIndex | Sequence[int | float],
    keys: Key[Array, " b"] | None = None,
) -> tuple[Float[Array, "b f h w c"], Kept, Visited]:
    """Return latents and last result as `integrate_keeping` does, and what all steps visited."""
    rows = jax.tree.map(jnp.asarray, _rows(process, solver, steps, keys))

    def seen(x: jax.Array, t: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array, Kept]]:
        output, kept = denoise(x, t)
        return output, (x, output.astype(jnp.float32), kept)

    def advance(carry: Any, row: tuple) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        state, (x, output, kept) = _advance(seen, process, solver, carry[0], row)
        return (state, kept), (x, output)

    # One program for all steps: the last results are carried, not appended for each step.
    _, empty = jax.eval_shape(denoise, noise, jnp.zeros(len(noise)))
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), empty)
    (state, kept), visited = jax.lax.scan(advance, (solver.start(noise), empty), rows)
    return state.x, kept, Visited(*visited, timesteps=rows[0])


def _rows(
    process: Process,
    solver: Solver,
    steps: SupportsIndex | Sequence[int | float],
    keys: Key[Array, " b"] | None,
) -> tuple:
    """Return timesteps, coefficients and, of a stochastic solver, keys with a leading step axis."""
    times = process.times(steps)
    timesteps = process.timesteps(times[:-1]).astype(np.float32)
    rows = (timesteps, solver.coefficients(process, times))
    if not solver.stochastic:
        return rows
    if keys is None:
        raise InputError(f"{type(solver).__name__} adds noise at its steps: it needs keys.")
    fold = jax.vmap(jax.random.fold_in, in_axes=(0, None))
    return (*rows, jax.vmap(fold, in_axes=(None, 0))(keys, jnp.arange(len(timesteps))))


def _advance(
    denoise: Callable[[jax.Array, jax.Array], tuple[jax.Array, Kept]],
    process: Process,
    solver: Solver,
    state: Any,
    row: tuple,
) -> tuple[Any, Kept]:
    """Return the state after one step, and the second result of the network."""
    t, coefficients, *step_keys = row
    output, kept = denoise(state.x, jnp.broadcast_to(t, state.x.shape[:1]))
    return solver.step(process, state, output, coefficients, *step_keys), kept


class Latents(NamedTuple):
    """State of a solver that keeps only the latents."""

    x: Float[Array, "*x"]


class EulerRow(NamedTuple):
    """Coefficients of one Euler step; with a leading step axis, of all steps."""

    alpha: Float[Any, ""]
    """Scale of the data at the step's start."""
    sigma: Float[Any, ""]
    """Scale of the noise at the step's start."""
    change: Float[Any, ""]
    """Change of sigma, negative."""


@dataclass(frozen=True, kw_only=True)
class Euler:
    """First-order solver along the velocity: the sampler of the EgoSim release."""

    stochastic = False

    def coefficients(self, process: Process, times: Float[np.ndarray, " times"]) -> EulerRow:
        """Return the change of sigma of each step."""
        alpha, sigma = process.alpha(times), process.sigma(times)
        if not np.allclose(alpha + sigma, 1):
            raise InputError(
                "The Euler solver needs a straight path (RectifiedFlow), not "
                f"{type(process).__name__}. Take DDIM, which is first order on any path."
            )
        columns = alpha[:-1], sigma[:-1], np.diff(sigma)
        return EulerRow(*(column.astype(np.float32) for column in columns))

    def start(self, x: Float[Array, "*x"]) -> Latents:
        """Return the noise as the first latents."""
        return Latents(x.astype(jnp.float32))

    def step(
        self,
        process: Process,
        state: Latents,
        output: Float[Array, "*x"],
        row: EulerRow,
        keys: Key[Array, " b"] | None = None,
    ) -> Latents:
        """Step along the velocity."""
        output = output.astype(jnp.float32)
        velocity = process.to_velocity(state.x, output, row.alpha, row.sigma)
        return Latents(state.x + row.change * velocity)


class DDIMRow(NamedTuple):
    """Coefficients of one DDIM step; with a leading step axis, of all steps."""

    alpha: Float[Any, ""]
    """Scale of the data at the step's start."""
    sigma: Float[Any, ""]
    """Scale of the noise there."""
    data: Float[Any, ""]
    """Factor of the predicted data."""
    epsilon: Float[Any, ""]
    """Factor of the predicted noise."""
    noise: Float[Any, ""]
    """Factor of the new noise, s."""


@dataclass(frozen=True, kw_only=True)
class DDIM:
    """First-order solver on any process; the default sampler of CogVideoX."""

    eta: float = 0.0
    """Share of new noise: 0 is deterministic, 1 the ancestral sampler."""

    def __post_init__(self) -> None:
        if not 0 <= self.eta <= 1:
            raise InputError(f"DDIM's eta must be between 0 and 1, not {self.eta}.")

    @property
    def stochastic(self) -> bool:
        """Return whether steps add noise."""
        return self.eta > 0

    def coefficients(self, process: Process, times: Float[np.ndarray, " times"]) -> DDIMRow:
        """Return the factors of data and noise of each step."""
        alpha, sigma = process.alpha(times), process.sigma(times)
        ratio = alpha[:-1] * sigma[1:] / (sigma[:-1] * alpha[1:])  # e^-h
        new = self._new_share(ratio)
        columns = (
            alpha[:-1],
            sigma[:-1],
            alpha[1:],
            sigma[1:] * np.sqrt(1 - new),
            sigma[1:] * np.sqrt(new),
        )
        return DDIMRow(*columns)

    def _new_share(self, ratio: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the share of the variance that is new, of steps with these ratios e^-h."""
        return self.eta**2 * (1 - ratio**2)

    def start(self, x: Float[Array, "*x"]) -> Latents:
        """Return the noise as the first latents."""
        return Latents(at_least_float32(x))

    def step(
        self,
        process: Process,
        state: Latents,
        output: Float[Array, "*x"],
        row: DDIMRow,
        keys: Key[Array, " b"] | None = None,
    ) -> Latents:
        """Rescale the predicted data and noise, and add new noise."""
        output = at_least_float32(output)
        data = process.to_x0(state.x, output, row.alpha, row.sigma)
        epsilon = process.to_epsilon(state.x, output, row.alpha, row.sigma)
        x = row.data * data + row.epsilon * epsilon
        return Latents(x if keys is None else x + row.noise * sample_noise(keys, x))


@dataclass(frozen=True, kw_only=True)
class Renoise(DDIM):
    """DDIM that replaces all noise at each step: the sampler of step-distilled networks.

    Such a network predicts the data at once; the next step begins from that data with new noise
    (Song et al. 2023, multistep consistency sampling; LightX2V's four steps of Wan).
    """

    eta: float = 1.0
    """At least the ancestral sampler's noise."""

    def _new_share(self, ratio: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return np.ones_like(ratio)
