"""Gymnasium environments: step a policy in a generated world or in the true tabletop world.

    env = gymnasium.make("egosim_jax/Tabletop-v0")
    envs = gymnasium.make_vec("egosim_jax/Tabletop-v0", num_envs=8)

An action is a row of numbers (`action_spec.py`). `env.unwrapped.chunk_step` takes one row for each
new frame of a clip. Sessions of remote clients are in `server`. Needs the extra `env`.

- `make`, `make_vec`: one environment, or several as a batch.
- `load_backend`: the world behind an environment.
- `ActionSpec`: layout and bounds of action rows.
- `MountedCamera`: further camera, fixed in the world, on the head or on a wrist.
- `Start`: scene, camera and hands from which an episode continues.
- `rewards`: `Reward`, `MoveObject`, `GoalImage`.
- `tasks`: tasks as text, such as "red box lifted by 10 cm", judged by the state.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.runtime.options import meant
from egosim_jax.runtime.phases import phase, show_phases
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.simulation.start import Start
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.interactive.env.backends import Backend
    from egosim_jax.interactive.env.single import WorldEnv
    from egosim_jax.interactive.env.vector import WorldVectorEnv
    from egosim_jax.simulation.episode import Episode

__all__ = [
    "ActionSpec",
    "MountedCamera",
    "Start",
    "load_backend",
    "make",
    "make_vec",
    "register",
]

ID = "egosim_jax/Tabletop-v0"
World = Literal["generated", "true"]
MODEL = "tabletop"
"""Model by default."""
_POSITIONAL = ("backend", "num_envs")


@show_phases()
def load_backend(
    world: World = "generated",
    *,
    config: str | None = None,
    weights: Path | str | None = None,
    perception: str = "classical",
    steps: int | None = None,
    batch: int = 1,
    compile: bool | Literal["behind"] = True,
    update_every: Literal["clip", "chunk"] = "clip",
    default: str = MODEL,
    episode: Episode | None = None,
) -> Backend:
    """Return the true tabletop world, or a model's world that batches up to `batch` clips.

    `config` names a model, or "preview", which needs no weights. Without it the model is `default`,
    and scenes that its weights were not made for get previews, as does all if `episode` is one.
    The model is compiled for all batch sizes now, over all devices. Stderr lists all that is loaded
    and compiled. Without `compile` it is compiled at the first step; with "behind" the smallest
    batch is compiled now, and the others in a thread. `update_every` updates the state after each
    clip or, with a causal student, after each chunk of a clip.
    """
    if world not in get_args(World):
        raise InputError(f"There is no world {world!r:.40}: it must be 'generated' or 'true'.")
    with phase(f"loads JAX and the {world} world of {config or default}"):
        from egosim_jax.generation.choose import choose
        from egosim_jax.generation.generator import Generator
        from egosim_jax.interactive.env.backends import GeneratedWorld
        from egosim_jax.interactive.env.batching import Batcher
        from egosim_jax.interactive.env.true_world import TrueWorld
        from egosim_jax.sharding import make_mesh, parts
        from egosim_jax.simulation.simulator import check_update_every
        from egosim_jax.types import MeshConfig

    folder = None if weights is None else Path(weights)
    maker = choose(
        config,
        folder,
        default=default,
        steps=steps,
        provenance=episode and episode.state.provenance,
        video=episode and episode.video,
    )
    if world == "true":
        return TrueWorld(video=maker.video)
    check_update_every(update_every, maker.chunk_frames, maker.name, perception)
    mesh = make_mesh(MeshConfig(data=-1, fsdp=1))
    generator = maker.load(mesh=mesh)
    if isinstance(generator, Generator):
        unit = parts("batch", mesh)
        generator = Batcher(generator, max_batch=max(batch, unit), unit=unit)
        if compile:
            generator.compile(behind=compile == "behind")
    return GeneratedWorld(
        generator=generator,
        video=maker.video,
        perception=perception,
        trained_on=maker.trained_on,
        previews_unknown_scenes=config is None and weights is None,
        update_every=update_every,
    )


def make(*, backend: Backend | None = None, world: World | None = None, **options: Any) -> WorldEnv:
    """Return a `WorldEnv` of a backend, or of a world by name, by default the generated one."""
    from egosim_jax.interactive.env.single import WorldEnv

    _check_options(WorldEnv, backend, world, options)
    batch = 1 + _observed_cameras(options)
    return WorldEnv(backend or load_backend(world or "generated", batch=batch), **options)


def make_vec(
    *,
    num_envs: int,
    backend: Backend | None = None,
    world: World | None = None,
    **options: Any,
) -> WorldVectorEnv:
    """Return a `WorldVectorEnv` of a backend, or of a world by name (`make`)."""
    from egosim_jax.interactive.env.vector import WorldVectorEnv

    _check_options(WorldVectorEnv, backend, world, options)
    batch = num_envs * (1 + _observed_cameras(options))
    chosen = backend or load_backend(world or "generated", batch=batch)
    return WorldVectorEnv(chosen, num_envs, **options)


def _observed_cameras(options: Mapping[str, Any]) -> int:
    """Return the number of further cameras that have clips."""
    from egosim_jax.interactive.env.chunks import observed

    return len(observed(options.get("cameras", ()), options.get("observe", ())))


def _check_options(env: type, backend: Any, world: Any, options: Mapping[str, Any]) -> None:
    """Raise `InputError` for options that cannot be: a world takes long to load."""
    from egosim_jax.interactive.env.rewards import reward_of
    from egosim_jax.interactive.env.single import check_settings

    if backend is not None and world is not None:
        raise InputError(f"Give a backend or a world, not both: world is {world!r:.40}.")
    if world is not None and not isinstance(world, str):
        raise InputError(
            f"The world is {type(world).__name__}: it must be 'generated' or 'true'. Pass what "
            "load_backend returns as backend=."
        )
    if isinstance(backend, str):
        raise InputError(f"The backend is {backend!r:.40}: name a world by world=.")
    checked = ("actions", "observe", "max_chunks", "cameras")
    check_settings(**{name: options[name] for name in checked if name in options})
    fields = [name for name in signature(env).parameters if name not in _POSITIONAL]
    allowed = ["backend", "world", *fields]
    if isinstance(reward := options.get("reward"), str):
        reward_of(reward)
    if unknown := [name for name in options if name not in allowed]:
        raise InputError(
            f"There is no option {unknown[0]!r:.40} of an environment.{meant(unknown[0], allowed)} "
            f"Options: {', '.join(allowed)}."
        )


def register() -> None:
    """Register the environment with Gymnasium. Importing this package calls it."""
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(
            ID,
            entry_point="egosim_jax.interactive.env:make",
            vector_entry_point="egosim_jax.interactive.env:make_vec",
        )


if find_spec("gymnasium"):
    register()
