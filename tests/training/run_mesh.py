"""Loss, gradients and 20 updates of a tiny model on a mesh.

DATA FSDP CONTEXT PARTS OUT.npz [TASK]
"""

import dataclasses
import sys

import jax
import numpy as np
from flax import nnx

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import ModelConfig
from egosim_jax.models.layers import init_sharded
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.sharding import batch_sharding, make_mesh, state_sharding
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.update import TrainState, make_update
from egosim_jax.types import MeshConfig, VideoSpec
from tests.training.run_tiny import TASKS as TINY

STEPS, BATCH = 20, 8
DEBUG = configs.get("debug")
# 2 x 2 x 4 tokens, and widths that eight devices divide.
MODEL = dataclasses.replace(
    DEBUG,
    video=VideoSpec(frames=5, height=32, width=64),
    encoders="frozen",
    dit=WanDiTConfig(
        dim=64, ffn_dim=96, heads=4, layers=2, text_dim=64, image_dim=32, remat="attention"
    ),
)
DWM = TINY["dwm"]
DROPOUT = ConditionDropout(prior=0.2, mask=0.2, hands=0.2, text=0.2)
TASKS = {
    "egosim": Denoising(model=MODEL, dropout=DROPOUT),
    "dwm": dataclasses.replace(
        DWM, model=dataclasses.replace(DWM.model, encoders="frozen"), dropout=DROPOUT
    ),
}


def batch(seed: int, model: ModelConfig) -> dict[str, np.ndarray]:
    """Random latents and embeddings."""
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(BATCH, *shape)).astype(np.float32)

    shape, dit = model.latent_shape, model.dit
    names = ("target", "prior", "hands")
    masks = model.layout.count("mask")
    return {
        **{name: draw(*shape, 16) for name in names},
        **({f"{name}_std": abs(draw(*shape, 16)) for name in names} if model.posterior else {}),
        "mask": rng.integers(0, 2, (BATCH, *shape, masks)).astype(np.uint8),
        "text": draw(8 if model.image is None else 7, dit.text_dim),
        **({} if dit.image_dim is None else {"image": draw(5, dit.image_dim)}),
    }


def main(data: int, fsdp: int, context: int, parts: int, out: str, task: str = "egosim") -> None:
    """Compute and write everything that must not depend on the mesh."""
    chosen = TASKS[task]
    mesh = make_mesh(MeshConfig(data=data, fsdp=fsdp, context=context))
    config = OptimizerConfig(learning_rate=1e-3)
    training = TrainConfig(steps=STEPS, optimizer=config, grad_accum_steps=parts)

    def create() -> TrainState:
        params = nnx.state(chosen.networks(nnx.Rngs(0)), nnx.Param)
        # Zeros, as the head begins with, would hide errors.
        leaves, tree = jax.tree.flatten(params)
        keys = jax.random.split(jax.random.key(1), len(leaves))
        noisy = [
            x + 0.05 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)
        ]
        return TrainState.create(jax.tree.unflatten(tree, noisy), config)

    graph = nnx.graphdef(nnx.eval_shape(lambda: chosen.networks(nnx.Rngs(0))))
    sharding = state_sharding(mesh, jax.eval_shape(create))
    placed = batch_sharding(mesh)
    state = init_sharded(create, out_shardings=sharding)
    keys = chosen.keys(jax.random.key(0), BATCH)

    def loss(params, batch):
        return chosen.loss(nnx.merge(graph, params), batch, keys)[0]

    def put(seed: int):
        return jax.device_put(batch(seed, chosen.model), placed)

    with jax.set_mesh(mesh):
        gradient = jax.jit(
            jax.value_and_grad(loss),
            in_shardings=(sharding.params, placed),
            out_shardings=(None, sharding.params),
        )
        value, gradients = gradient(state.params, put(0))
        update = jax.jit(
            make_update(chosen, graph, training),
            in_shardings=(sharding, None, placed),
            out_shardings=(sharding, None),
        )
        curve = []
        for step in range(STEPS):
            state, metrics = update(state, nnx.State({}), put(step))
            curve.append(float(metrics["loss"]))
    leaves = {
        ".".join(map(str, path)): np.asarray(leaf.get_value())
        for path, leaf in nnx.to_flat_state(gradients)
    }
    np.savez(out, loss=np.asarray(value), curve=np.array(curve), **leaves)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:5]), *sys.argv[5:])
