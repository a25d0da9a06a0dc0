"""Tasks of a student's training, with denoisers that need no compilation, and their update."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.sharding import Mesh

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.data.shards import ShardReader
from egosim_jax.models.chunks import Chunks
from egosim_jax.runtime.command import CommandExit
from egosim_jax.train import recipes
from egosim_jax.train.config import CriticConfig, OptimizerConfig, TrainConfig
from egosim_jax.train.monitor import SkipMonitor
from egosim_jax.train.task import Roles
from egosim_jax.train.tasks.consistency import Consistency
from egosim_jax.train.tasks.matching import Matching
from egosim_jax.train.update import Programs, mean_metrics
from egosim_jax.types import InputError, VideoSpec
from tests.training.line import write_points

DEBUG = configs.get("debug")
MODEL = dataclasses.replace(
    DEBUG, video=VideoSpec(frames=9, height=32, width=32), chunks=Chunks(sizes=(1, 2)), steps=2
)


class Fake:
    """Denoiser whose prediction of the data is `clip`, wherever it is asked."""

    def __init__(self, clip):
        self.clip, self.times, self.caches = clip, [], []

    def velocity(self, x, t, clip):
        self.times.append(t)
        level = t.reshape(*t.shape, *[1] * (x.ndim - t.ndim)) / 1000
        return (x - clip) / level

    def share(self, text, image=None):
        return None

    def prepare(self, condition, text, image=None):
        return 0

    def prepare_chunk(self, condition, shared, first_frame):
        return slice(first_frame, first_frame + condition.shape[1])

    def empty_cache(self, batch, latents):
        return Kept()

    def denoise(self, noisy, t, context):
        return self.velocity(noisy, t, self.clip)

    def denoise_chunk(self, noisy, t, context, cache):
        self.caches.append(cache.chunks)
        return self.velocity(noisy, t, self.clip[:, context]), jnp.zeros(1)

    def denoise_packed(self, clean, noisy, t, context, chunks):
        lengths = np.array(chunks.sizes)
        return self.velocity(noisy, jnp.repeat(t, lengths, axis=1), self.clip)


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Kept:
    chunks: int = dataclasses.field(default=0, metadata={"static": True})

    def put(self, chunk):
        return Kept(self.chunks + 1)


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.normal(size=(2, *shape)), jnp.float32)  # noqa: E731
    streams = {name: draw(*MODEL.latent_shape, 16) for name in ("target", "prior", "hands")}
    mask = jnp.zeros((2, *MODEL.latent_shape, 4), jnp.uint8)
    return {**streams, "mask": mask, "text": draw(3, 64), "image": draw(3, 32)}


def roles(**clips):
    made = {name: Networks(dit=Fake(clip)) for name, clip in clips.items()}
    return Roles(**{name: made.get(name) for name in Roles._fields})


def loss(task, parts, batch):
    found, metrics = task.loss(parts, batch, task.keys(jax.random.key(0), 2))
    return float(found), metrics


def test_a_student_that_makes_the_recorded_clip_has_no_regression(batch):
    task, parts = Matching(model=MODEL, matching=0.0), roles(student=batch["target"])
    assert loss(task, parts, batch)[0] == pytest.approx(0, abs=1e-8)
    away = roles(student=batch["target"] + 2)
    assert loss(task, away, batch)[0] == pytest.approx(0.25 * 4, rel=1e-4)
    caches = parts.student.dit.caches
    assert caches[-2:] == [0, 1]  # the replay of each chunk has the cache of those before it
    levels = {float(t) for time in parts.student.dit.times[-2:] for t in time}
    assert levels <= {float(t) for t in MODEL.process.timesteps(MODEL.process.times(2)[:-1])}


def test_matching_moves_the_clip_from_the_critics_prediction_to_the_teachers(batch):
    task, target = Matching(model=MODEL, regression=0.0), batch["target"]
    same = roles(student=target, teacher=target + 1, critic=target + 1)
    assert float(loss(task, same, batch)[1]["gap"]) == pytest.approx(0, abs=1e-4)
    parts = roles(student=target, teacher=target + 2, critic=target + 1)
    gap = task._gap(parts, task._condition(parts, batch, task.keys(jax.random.key(0), 2)), target,
                    jax.random.split(jax.random.key(1), 2))  # fmt: skip
    np.testing.assert_allclose(gap, -0.5, rtol=1e-3)  # (1 - 2) / 2


def test_a_critic_learns_the_students_clips(batch):
    task, target = Matching(model=MODEL), batch["target"]
    parts = roles(student=target + 3, critic=target + 3, teacher=target)
    found, _ = task.critic_loss(parts, batch, task.keys(jax.random.key(0), 2))
    assert float(found) == pytest.approx(0, abs=1e-4)
    assert Matching(model=MODEL, matching=0.0).critic is None


def test_consistent_predictions_have_no_loss_and_chunks_have_their_times(batch):
    task, target = Consistency(model=MODEL), batch["target"]
    parts = roles(student=target, average=target, teacher=target)
    assert loss(task, parts, batch)[0] == pytest.approx(0, abs=1e-4)
    (now,), (after,) = parts.student.dit.times, parts.average.dit.times
    np.testing.assert_array_equal(now, parts.teacher.dit.times[0])
    assert (after < now).all()
    assert (now[:, 1] == now[:, 2]).all()
    assert (now[:, 0] != now[:, 1]).any()
    other = roles(student=target + 1, average=target, teacher=target)
    assert loss(task, other, batch)[0] == pytest.approx(1, rel=1e-4)


class Number(nnx.Module):
    def __init__(self):
        self.value = nnx.Param(jnp.ones(2), axes=(None,))


@dataclasses.dataclass(frozen=True)
class Following:
    """Task of a number that follows its critic, which follows twice the teacher."""

    critic = CriticConfig(updates=3, optimizer=OptimizerConfig(learning_rate=0.1))
    trained = nnx.Param
    frozen_dtype = "float32"

    def networks(self, rngs):
        return Number()

    def examples(self):
        return None

    def shapes(self, batch):
        return {"x": jax.ShapeDtypeStruct((batch,), np.float32)}

    def keys(self, key, batch):
        return jax.random.split(key, batch)

    def loss(self, roles, batch, keys):
        assert roles.average.value.shape == (2,)
        return jnp.square(roles.student.value[...] - roles.critic.value[...]).sum(), {}

    def critic_loss(self, roles, batch, keys):
        return jnp.square(roles.critic.value[...] - 2 * roles.teacher.value[...]).sum(), {}

    def validate(self, networks, batch):
        return {}

    def flops(self, samples):
        return float("nan")


def test_an_update_trains_the_critic_several_times_and_never_the_teacher():
    optimizer = OptimizerConfig(learning_rate=0.1, ema_decay=0.5)
    training = TrainConfig(steps=4, batch_size=2, optimizer=optimizer)
    mesh = Mesh(np.array(jax.devices()[:1]).reshape(1, 1, 1), ("data", "fsdp", "context"))
    programs = Programs.of(Following(), training, mesh)
    with jax.set_mesh(mesh):
        state = programs.create(None, jax.tree.map(lambda x: 3 * x, nnx.state(Number())))
        assert float(state.critic.params["value"][0]) == 3
        state, metrics = programs.update(state, programs.frozen, {"x": jnp.zeros(2)})
    assert (int(state.step), int(state.critic.step)) == (1, 3)
    assert float(state.critic.params["value"][0]) == pytest.approx(3.3, abs=1e-3)
    assert float(state.params["value"][0]) == pytest.approx(1.1, abs=1e-3)
    assert float(state.teacher["value"][0]) == 3
    assert {"critic_loss", "critic_grad_norm", "loss"} <= metrics.keys()


@dataclasses.dataclass(frozen=True)
class Diverging(Following):
    """The same with a critic whose every update is NaN."""

    def critic_loss(self, roles, batch, keys):
        return jnp.nan * roles.critic.value[...].sum(), {}


def test_a_critics_skipped_updates_are_counted_and_end_the_run(tmp_path):
    training = TrainConfig(steps=4, batch_size=2, optimizer=OptimizerConfig(learning_rate=0.1))
    mesh = Mesh(np.array(jax.devices()[:1]).reshape(1, 1, 1), ("data", "fsdp", "context"))
    programs = Programs.of(Diverging(), training, mesh)
    with jax.set_mesh(mesh):
        state = programs.create(None, nnx.state(Number()))
        state, metrics = programs.update(state, programs.frozen, {"x": jnp.zeros(2)})
    assert int(metrics["critic_consecutive_skips"]) == 3
    means = mean_metrics([metrics])
    assert means["skipped_critic_updates"] == 3
    assert np.isfinite(list(means.values())).all()
    monitor = SkipMonitor(ShardReader(write_points(tmp_path / "points")))
    monitor.watch(1, metrics, np.zeros(0, int))
    with pytest.raises(CommandExit, match="by the critic"):
        monitor.check()


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"chunks": None}, "at once"), ({"chunks": (2, 2)}, "make a clip of 4"), ({"steps": 0}, "0")],
)
def test_a_student_without_fitting_chunks_or_steps_is_refused(changes, message):
    recipe = dataclasses.replace(recipes.get("tabletop_student_dmd"), **changes)
    with pytest.raises(InputError, match=message):
        recipe.stages()
