"""Online training: its scenes, its pools, its latents made beforehand, and its updates."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from optax.contrib import MuonDimensionNumbers, muon

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.runtime.command import ExitCode
from egosim_jax.train.__main__ import main as egosim_train
from egosim_jax.train.config import OptimizerConfig, make_optimizer
from egosim_jax.train.online.latents import read_latents, write_shard
from egosim_jax.train.online.plan import OnlineTraining
from egosim_jax.train.online.pool import CHUNK, Pool, latent_shapes, raw_shapes
from egosim_jax.train.online.run import OnlineRun, schedule
from egosim_jax.train.online.scenes import (
    REACH_M,
    EndlessScenes,
    make_idle,
    queued,
    row_of,
    wander,
    write_row,
)
from egosim_jax.types import InputError

DEBUG = configs.get("debug")
SMALL = replace(DEBUG, video=replace(DEBUG.video, height=32, width=48))
"""Images that are drawn quickly."""


def rows_of(count, seed=0):
    draw = np.random.default_rng(seed)
    return {
        name: draw.normal(size=s.shape).astype(s.dtype)
        if np.issubdtype(s.dtype, np.floating)
        else draw.integers(0, 2, s.shape).astype(s.dtype)
        for name, s in latent_shapes(DEBUG, count).items()
    }


def test_a_seed_gives_the_same_clips_and_every_kind_of_scene_occurs(tmp_path):
    scenes = EndlessScenes(model=SMALL, clips=1, attempts=0.0, encounters=0.0, idle=0.5)
    first, second = ([next(scenes.clips_of(seed)) for seed in range(n)] for n in (6, 3))
    for one, other in zip(first, second, strict=False):
        np.testing.assert_array_equal(one.frames, other.frames)
    assert {clip.verb == "execute" for clip in first} == {True, False}
    assert {clip.kind for clip in first} == {"human", "robot"}
    row = row_of(next(scenes.triplets(3)), SMALL)
    assert {name: (array.shape, array.dtype) for name, array in row.items()} == {
        name: (s.shape[1:], s.dtype) for name, s in raw_shapes(SMALL, 1).items()
    }
    write_row(tmp_path, "3_0", row)
    (path,) = queued(tmp_path)
    np.testing.assert_array_equal(np.load(path)["target"], row["target"])


def test_fused_states_have_what_the_frames_show_and_need_no_other_clips():
    scripts = EndlessScenes(model=SMALL, idle=0.0, attempts=0.0, encounters=0.0)
    moved, fused = (replace(scripts, fused=share) for share in (0.0, 1.0))
    one, other = (list(scenes.triplets(3)) for scenes in (moved, fused))
    np.testing.assert_array_equal(one[0].prior, other[0].prior)
    np.testing.assert_array_equal(one[1].target, other[1].target)
    assert other[1].mask.sum() < one[1].mask.sum()  # places that the first clip showed


def test_idle_hands_rest_are_absent_or_wander():
    kinds = set()
    for seed in range(12):
        (clip,) = make_idle(seed, spec=SMALL.video)
        joints = clip.joints_m[:, 0]
        kinds.add(
            "absent" if np.isnan(joints).all() else float(np.ptp(joints[:, 0], axis=0).max()) > 0
        )
    assert kinds == {"absent", True, False}
    path = wander(200, np.random.default_rng(0))
    assert np.abs(path).max() <= REACH_M
    assert (path[0] == 0).all()


def test_latents_of_eight_bits_are_read_to_one_in_220_of_their_range(tmp_path):
    rows, read = rows_of(2 * CHUNK), set()
    write_shard(tmp_path / "a.npz", rows)
    found = list(read_latents(tmp_path, read, DEBUG, limit=5))
    assert len(found) == 2
    assert not list(read_latents(tmp_path, read, DEBUG, limit=5))
    for name, array in rows.items():
        got = np.concatenate([chunk[name] for chunk in found]).astype(np.float32)
        exact = not np.issubdtype(array.dtype, np.floating)
        bound = 0 if exact else np.abs(array).max() / 220
        np.testing.assert_allclose(got, array.astype(np.float32), atol=bound, rtol=0)


def test_a_full_pool_forgets_its_oldest_clips():
    pool = Pool(latent_shapes(DEBUG, 2 * CHUNK))
    for seed in range(3):
        pool.append(rows_of(CHUNK, seed))
    assert len(pool) == 2 * CHUNK
    np.testing.assert_array_equal(pool.arrays["ids"][:CHUNK], rows_of(CHUNK, 2)["ids"])
    np.testing.assert_array_equal(pool.arrays["ids"][CHUNK:], rows_of(CHUNK, 1)["ids"])
    with pytest.raises(ValueError, match="multiple of 16"):
        Pool(latent_shapes(DEBUG, CHUNK + 1))


def test_grouped_muon_equals_muon_of_each_weight():
    draw = np.random.default_rng(0)
    shapes = {
        "stacked": ((2, 4, 6), ("layers", "embed", "mlp")),
        "tall": ((6, 4), ("mlp", "embed")),
        "convolution": ((3, 2, 4), (None, "embed", "mlp")),
        "embedding": ((9, 4), ("vocab", "embed")),
        "bias": ((4,), ("embed",)),
    }

    def variables_of_random_values():
        return {
            name: nnx.Param(jnp.asarray(draw.normal(size=shape), jnp.float32), axes=axes)
            for name, (shape, axes) in shapes.items()
        }

    params, gradients = nnx.State(variables_of_random_values()), variables_of_random_values()
    gradients = nnx.State(gradients)
    config = OptimizerConfig(name="muon", weight_decay=0.05)

    def axes(leaf):
        """Return the axes of a matrix `[layers?, ..., in, out]`; embeddings are not matrices."""
        names = leaf.get_metadata().get("axes", ())
        layers = int(names[:1] == ("layers",))
        if isinstance(leaf.get_value(), optax.MaskedNode) or "vocab" in names:
            return None
        rank = len(leaf.shape)
        return (
            None
            if rank - layers < 2
            else MuonDimensionNumbers((*range(layers, rank - 1),), rank - 1)
        )

    variables = lambda leaf: isinstance(leaf, nnx.Variable)  # noqa: E731
    single = optax.chain(
        optax.clip_by_global_norm(1.0),
        muon(
            1.0,
            weight_decay=0.05,
            consistent_rms=0.2,
            muon_weight_dimension_numbers=lambda tree: jax.tree.map(
                lambda leaf: leaf.replace(axes(leaf)), tree, is_leaf=variables
            ),
        ),
    )
    updates = []
    for optimizer in (single, make_optimizer(config)):
        update = jax.jit(optimizer.update)
        found, state = update(gradients, optimizer.init(params), params)
        found, _ = update(gradients, state, params)
        updates.append(jax.tree.leaves(found))
    for one, other in zip(*updates, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-4)


def test_the_schedule_falls_to_a_hundredth():
    assert [schedule(share) for share in (0.0, 0.5, 1.0)] == pytest.approx([1, 0.5, 0.01])


def test_egosim_train_has_online_training_with_its_own_options(capsys):
    arguments = ["tabletop", "--online", "--minutes", "1"]
    with pytest.raises(SystemExit) as ended:
        egosim_train(arguments, program="egosim train")
    assert ended.value.code == ExitCode.USAGE
    assert "--out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"minutes": None}, "needs an end"),
        ({"config": "debug"}, r"no weights of debug.*--weights"),
    ],
)
def test_a_training_without_an_end_or_weights_is_refused(options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        OnlineTraining(**options, out=tmp_path)


@pytest.mark.slow
def test_a_run_is_the_same_in_programs_of_two_updates_and_when_it_was_interrupted(tmp_path):
    Networks.random(DEBUG, seed=0).save(tmp_path / "start")
    (tmp_path / "latents").mkdir()
    write_shard(tmp_path / "latents" / "a.npz", rows_of(2 * CHUNK))

    def train(out, per_program, *, until=9):
        plan = OnlineTraining(
            config="debug", weights=tmp_path / "start", out=tmp_path / out, minutes=None,
            updates=4, workers=0,
            latents=tmp_path / "latents", batch=4, per_program=per_program, decoder_share=0.0,
            first_clips=CHUNK, clips=2 * CHUNK, frames=CHUNK, save_s=0.0,
        )  # fmt: skip
        run = OnlineRun(plan)
        update = run._update

        def limited(share):
            if run.progress.done == until:
                raise KeyboardInterrupt
            return update(share)

        run._update = limited
        run.train()
        return run

    one, two = train("one", 1), train("two", 2)
    with pytest.raises(KeyboardInterrupt):
        train("resumed", 1, until=3)
    resumed = train("resumed", 1)
    assert resumed.progress.get_state() | {"seconds": 0, "first": 0} == (
        one.progress.get_state() | {"seconds": 0, "first": 0}
    )
    for a, b in zip(*(jax.tree.leaves(run.state) for run in (one, resumed)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(one.state.step) == int(two.state.step) == 4
    for a, b in zip(*(jax.tree.leaves(run.state.params) for run in (one, two)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    Networks.load(DEBUG, tmp_path / "one" / "weights")
