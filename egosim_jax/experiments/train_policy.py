"""`egosim experiment train_policy`: does training in a generated world help in the true world?

A linear policy says where a hand pinches an object, and how. It is fitted to a few poor
demonstrations, improved by PPO of a public library in a generated world, and judged before and
after in other scenes: by states of the generated world, and by the true tabletop world.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import count, islice

import numpy as np

from egosim_jax.evaluation.metrics.rates import difference, rate
from egosim_jax.evaluation.metrics.report import print_table
from egosim_jax.experiments.config import TrainPolicy
from egosim_jax.experiments.ppo import LIBRARIES, Weights
from egosim_jax.experiments.report import cached, write_report
from egosim_jax.interactive.env import ActionSpec, load_backend, make_vec
from egosim_jax.interactive.env.backends import Backend, tabletop_start
from egosim_jax.interactive.env.chunks import make_chunk
from egosim_jax.interactive.learn.flat import FlatVectorEnv
from egosim_jax.interactive.learn.lift import REACH_M, Lift
from egosim_jax.io.run import open_folder
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import World, start_of_sequence

PLACE_M, CLOSURES, TURN = 0.05, (0.0, 0.75), 0.3
"""Faults of the demonstrations, as numbers of an action.

Standard deviation of the place in meters, range of the closure, standard deviation of the turn."""
RIDGE = 0.05
"""Weight decay of the fit to the demonstrations."""
WORLDS = {"generated": ("generated world %", "{:.0f}"), "true": ("true world %", "{:.0f}")}
DEFINITIONS = {
    "success": "share of scenes in which the object rises by 5 cm, in percent; 95 % interval of "
    "Clopper and Pearson",
    "difference": "after minus before, on the same scenes, with its 95 % interval",
    "generated": "by the state that perception updates by the generated clip",
    "true": "by the pose of the body in the tabletop world, which executes the same rows",
}


def run(settings: TrainPolicy) -> None:
    """Clone, train, judge both policies, and print their success with intervals."""
    settings.check()
    open_folder(settings.out, {"experiment": settings})
    backend = load_backend("generated", config=settings.config, batch=settings.batch_size)
    scenes = _scenes(settings.first_scene, settings.scenes, backend.video)
    tests = _scenes(settings.first_test, settings.tests, backend.video)
    envs = _environment(backend, settings.batch_size, scenes)
    before = clone(envs, demonstrations=settings.demonstrations, seed=settings.seed)
    train = partial(
        LIBRARIES[settings.library],
        envs,
        before,
        rounds=settings.rounds,
        steps=settings.steps,
        seed=settings.seed,
    )
    after = np.array(cached(settings.out / "trained.json", lambda: train().tolist()))
    judges = {
        "generated": partial(succeeds_generated, backend, size=settings.batch_size),
        "true": partial(succeeds_true, backend),
    }
    outcomes: dict[str, dict[str, list[bool]]] = {"before": {}, "after": {}}
    for name, weights in (("before", before), ("after", after)):
        for world, judge in judges.items():
            path = settings.out / f"{name}_{world}.json"
            outcomes[name][world] = cached(path, partial(judge, weights, tests))
    _report(settings, outcomes, {"before": before, "after": after}, tests)


def act(weights: Weights, seen: np.ndarray) -> np.ndarray:
    """Return the actions of a linear policy, each from -1 to 1."""
    return np.clip(np.concatenate([seen, np.ones((len(seen), 1))], axis=1) @ weights, -1, 1)


def clone(envs: FlatVectorEnv, *, demonstrations: int, seed: int) -> Weights:
    """Return the policy that fits demonstrations, whose places, closures and turns are poor."""
    rng = np.random.default_rng(seed)
    rounds = -(-demonstrations // envs.num_envs)
    seeds = [int(s) for s in envs.scenes[np.arange(rounds * envs.num_envs) % len(envs.scenes)]]
    batches = [seeds[n * envs.num_envs : (n + 1) * envs.num_envs] for n in range(rounds)]
    seen = np.concatenate([envs.reset(seed=batch)[0] for batch in batches])[:demonstrations]
    closures = rng.uniform(*CLOSURES, (demonstrations, 1))
    acted = np.concatenate(
        [
            seen[:, :3] + rng.normal(size=(demonstrations, 3)) * PLACE_M / REACH_M,
            2 * closures - 1,
            rng.normal(size=(demonstrations, 1)) * TURN,
        ],
        axis=1,
    )
    inputs = np.concatenate([seen, np.ones((demonstrations, 1))], axis=1)
    return np.linalg.solve(inputs.T @ inputs + RIDGE * np.eye(inputs.shape[1]), inputs.T @ acted)


def succeeds_generated(
    backend: Backend, weights: Weights, scenes: Sequence[int], *, size: int
) -> list[bool]:
    """Return in which scenes of the generated world a policy lifts the object."""
    results: list[bool] = []
    envs, padded = _environment(backend, size, scenes), [*scenes, *[scenes[-1]] * (size - 1)]
    firsts = range(0, len(scenes), size)
    for first in track(firsts, "judging in the generated world", total=len(firsts)):
        seen, _ = envs.reset(seed=padded[first : first + size])
        *_, info = envs.step(act(weights, seen))
        results += info["success"].tolist()
    return results[: len(scenes)]


def succeeds_true(backend: Backend, weights: Weights, scenes: Sequence[int]) -> list[bool]:
    """Return in which scenes of the true world a policy lifts the object."""
    skill, spec, results = Lift(), ActionSpec(), []
    for seed in track(scenes, "judging in the true world", total=len(scenes)):
        start = tabletop_start(seed, spec, backend.video)
        scene = start_of_sequence(seed, spec=backend.video, kind=spec.kind)[0]
        number = skill.target(start.state)
        action = act(weights, skill.see(start.state)[None])[0]
        rows = skill.path(action, spec.rest, spec, frames=backend.video.frames)
        rows = np.clip(rows, *spec.bounds)
        chunk = make_chunk(spec, rows, start=start, video=backend.video)
        _, after = World(scene=scene, seed=seed).move(chunk.action)
        (body,) = (b for b in scene.bodies if scene.instance_id(b.name) == number)
        moved = after.scene.body(body.name).world_from_body - body.world_from_body
        results.append(bool(moved[2, 3] >= skill.height_m))
    return results


def _environment(backend: Backend, size: int, scenes: Sequence[int]) -> FlatVectorEnv:
    skill = Lift()
    envs = make_vec(num_envs=size, backend=backend, observe=(), reward=skill, max_chunks=1)
    return FlatVectorEnv(envs, skill, scenes=scenes)


def _scenes(first: int, number: int, video: VideoSpec) -> list[int]:
    """Return the seeds of scenes with an object that a hand can lift."""

    def can(seed: int) -> bool:
        try:
            Lift().target(tabletop_start(seed, ActionSpec(), video).state)
        except InputError:
            return False
        return True

    return list(islice(filter(can, count(first)), number))


def _report(
    settings: TrainPolicy,
    outcomes: dict[str, dict[str, list[bool]]],
    weights: dict[str, Weights],
    tests: Sequence[int],
) -> None:
    table = {
        name: {world: rate(sum(values), len(values)) for world, values in by_world.items()}
        for name, by_world in outcomes.items()
    }
    table["difference"] = {
        world: difference(outcomes["after"][world], outcomes["before"][world]) for world in WORLDS
    }
    write_report(
        settings.out,
        definitions=DEFINITIONS,
        scenes=list(tests),
        table=table,
        success=outcomes,
        weights={name: values.tolist() for name, values in weights.items()},
    )
    clips = settings.rounds * settings.steps * settings.batch_size
    title = f"success in {len(tests)} scenes; PPO of {settings.library}, {clips} clips"
    print_table("policy", table, WORLDS, title=title)
