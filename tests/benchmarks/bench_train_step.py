"""A training step of the `tabletop` denoiser, ours jitted, versus torch's eager, in float32.

Forward, backward and update of the video transformer with its text and image encoders, on a batch
of 8 clips of 5 x 12 x 20 latents. Theirs are the same networks in diffusers and transformers, and
the same rule in torch: the gradient clipped to norm 1, Muon for matrices, AdamW for the rest. Noise
and noise levels are given and nothing is drawn. Before anything is timed, both must find the same
loss and the same norm of the gradient, and the same loss again after a step.

torch's Muon orthogonalises in bfloat16, one matrix after the other; optax's in the gradients'
float32, the matrices of all layers together. So the update's share of their step is printed, too.

Calls alternate as in `bench_wan_dit`, which says how ratio and interval are found. On a busy
machine torch's threads wait for one another at the end of every small product, which lengthens its
wall and processor seconds both: with neighbors, believe `--threads 1`.

    python -m tests.benchmarks.bench_train_step [--pairs 9]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from tests.benchmarks.bench_wan_dit import THREADS, interleave, interval

if TYPE_CHECKING:
    import torch

    from egosim_jax.configs.model import ModelConfig

GOAL, BAR = 1.0, 1.25
"""Ratio of times, ours to theirs: the goal, and the maximum."""
BATCH = 8
LEARNING_RATE = 2e-3
LOSS, LATER = 1e-4, 1e-2
"""Relative tolerances of the first loss and gradient, and of the loss after a step.

The first are in float32; for the second, torch orthogonalizes matrices in bfloat16.
"""

Batch = Mapping[str, np.ndarray]
Step = Callable[[], tuple[float, float]]
"""Makes an update; the loss before it and the norm of its gradient."""


def main(pairs: int = 9, threads: int = THREADS) -> None:
    """Time a training step of both, in turns.

    Args:
        pairs: Interleaved pairs of steps, at least 9.
        threads: Processors that both may use.
    """
    if pairs < 9:
        raise SystemExit(f"--pairs must be at least 9, not {pairs}.")
    # XLA takes its number of threads from the process's processors, before it starts.
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    from egosim_jax import configs

    config = configs.get("tabletop")
    batch = make_batch(config)
    theirs = Theirs.make(config, batch, threads)
    ours = our_step(config, batch, theirs)
    check(ours, theirs.step)
    theirs.updating.clear()
    times = interleave(ours, theirs.step, pairs)
    ratios = sorted(ours.wall / theirs.wall for ours, theirs in times)
    ratio, (low, high, level) = median(ratios), interval(pairs)
    wall = median(theirs.wall for _, theirs in times)
    print(
        f"step on {threads} threads: ours {median(ours.wall for ours, _ in times):.2f} s, "
        f"torch {wall:.2f} s (the update alone {median(theirs.updating):.2f} s), "
        f"ratio {ratio:.3f} [{ratios[low]:.3f}, {ratios[high]:.3f}] "
        f"({level:.1%}, {pairs} pairs), of processor seconds "
        f"{median(ours.processor / theirs.processor for ours, theirs in times):.3f}; "
        f"goal {GOAL}: {'met' if ratio <= GOAL else 'MISSED'}, "
        f"bar {BAR}: {'met' if ratio <= BAR else 'MISSED'}"
    )


def make_batch(config: ModelConfig) -> Batch:
    """A cached batch of random numbers, with noise and noise levels."""
    rng = np.random.default_rng(0)
    shape = (BATCH, *config.latent_shape)
    videos = {
        name: rng.standard_normal((*shape, config.vae.z_dim), np.float32)
        for name in ("target", "prior", "hands", "noise")
    }
    tokens, size = config.tokenizer.max_tokens, config.image.image_size
    return {
        **videos,
        "mask": rng.integers(0, 2, (*shape, 4), np.uint8),
        "ids": rng.integers(0, config.text.vocab, (BATCH, tokens), np.int32),
        "ids_mask": np.arange(tokens) < rng.integers(tokens // 4, tokens, (BATCH, 1)),
        "pixels": rng.standard_normal((BATCH, size, size, 3), np.float32),
        "sigma": np.linspace(0.05, 0.95, BATCH, dtype=np.float32),
    }


def check(ours: Step, theirs: Step) -> None:
    """Raise AssertionError unless both start from the same place and go the same way."""
    np.testing.assert_allclose(ours(), theirs(), rtol=LOSS)
    np.testing.assert_allclose(ours()[0], theirs()[0], rtol=LATER)


def our_step(config: ModelConfig, batch: Batch, theirs: Theirs) -> Step:
    """The trainer's own update, from their weights."""
    import jax
    import jax.numpy as jnp
    from flax import nnx

    from egosim_jax.configs.model import Networks
    from egosim_jax.convert.tables import clip_vision, umt5, wan_dit
    from egosim_jax.io.weights import fill
    from egosim_jax.train.config import OptimizerConfig, TrainConfig
    from egosim_jax.train.tasks.denoising import Denoising, condition_of
    from egosim_jax.train.update import TrainState, make_update
    from tests.translation import translate

    class GivenNoise(Denoising):
        """The task, but for noise and noise levels, which are the batch's."""

        def loss(self, networks: Networks, batch: Any, keys: jax.Array) -> tuple[jax.Array, dict]:
            condition = condition_of(networks, batch, self.model)

            def velocity(x: jax.Array, t: jax.Array) -> jax.Array:
                channels = config.layout.assemble(x, condition)
                return networks.dit(channels, t, condition.text, condition.image)

            parts = (batch[name] for name in ("target", "noise", "sigma"))
            return self.objective.loss_at(config.process, velocity, *parts).mean(), {}

    task = GivenNoise(model=config)
    networks = nnx.eval_shape(lambda: task.networks(nnx.Rngs(0)))
    for network, module, rules, ignored in (
        (networks.dit, theirs.dit, wan_dit.diffusers(config.dit), []),
        (networks.text, theirs.text, umt5.transformers(config.text), umt5.ignored(config.text)),
        (
            networks.image,
            theirs.image,
            clip_vision.transformers(config.image),
            clip_vision.ignored(config.image),
        ),
    ):
        tensors = {name: tensor.numpy() for name, tensor in module.state_dict().items()}
        fill(network, translate(tensors, rules, ignore=ignored))
    graph, params, frozen = nnx.split(networks, task.trained, ...)

    optimizer = OptimizerConfig(name="muon", learning_rate=LEARNING_RATE)
    training = TrainConfig(steps=1, optimizer=optimizer)
    update = jax.jit(make_update(task, graph, training), donate_argnums=0)
    state = TrainState.create(params, optimizer)
    placed = {name: jnp.asarray(array) for name, array in batch.items()}

    def step() -> tuple[float, float]:
        nonlocal state
        state, metrics = update(state, frozen, placed)
        jax.block_until_ready(state)
        return float(metrics["loss"]), float(metrics["grad_norm"])

    return step


@dataclass(kw_only=True)
class Theirs:
    """The same networks and rule in torch, which start from random weights."""

    dit: torch.nn.Module
    text: torch.nn.Module
    image: torch.nn.Module
    inputs: Mapping[str, torch.Tensor]
    """The batch, channels first."""
    matrices: list[tuple[torch.nn.Parameter, torch.Tensor]] = field(init=False)
    """Yield what Muon trains: the parameter, and a matrix in the same memory."""
    rules: tuple[torch.optim.Optimizer, ...] = field(init=False)
    """Muon and AdamW."""
    updating: list[float] = field(default_factory=list)
    """Seconds that each step spent in clipping and update."""

    @classmethod
    def make(cls, config: ModelConfig, batch: Batch, threads: int) -> Theirs:
        """Random networks without dropout, of the shapes of `config`."""
        import torch
        from diffusers import WanTransformer3DModel
        from transformers import CLIPVisionConfig, CLIPVisionModel, UMT5Config, UMT5EncoderModel

        torch.set_num_threads(threads)
        torch.manual_seed(0)
        dit, text, image = config.dit, config.text, config.image
        modules = {
            "dit": WanTransformer3DModel(
                num_attention_heads=dit.heads, attention_head_dim=dit.head_dim,
                in_channels=dit.in_channels, out_channels=dit.out_channels, text_dim=dit.text_dim,
                ffn_dim=dit.ffn_dim, num_layers=dit.layers, cross_attn_norm=True, eps=dit.eps,
                image_dim=dit.image_dim, added_kv_proj_dim=dit.dim,
            ),
            "text": UMT5EncoderModel(
                UMT5Config(
                    vocab_size=text.vocab, d_model=text.dim, d_kv=text.head_dim, d_ff=text.ffn_dim,
                    num_layers=text.layers, num_heads=text.heads,
                    relative_attention_num_buckets=text.buckets,
                    relative_attention_max_distance=text.max_distance,
                    feed_forward_proj="gated-gelu",
                )
            ),
            # Without the last block, whose output the denoiser does not read.
            "image": CLIPVisionModel(
                CLIPVisionConfig(
                    hidden_size=image.dim, intermediate_size=image.ffn_dim,
                    num_hidden_layers=image.blocks, num_attention_heads=image.heads,
                    image_size=image.image_size, patch_size=image.patch, layer_norm_eps=image.eps,
                    hidden_act="gelu",
                )
            ),
        }  # fmt: skip
        modules = {name: module.eval() for name, module in modules.items()}
        for block in modules["dit"].blocks:
            block.attn2.set_processor(CrossAttention(image.tokens))
        return cls(inputs=_channels_first(batch, config), **modules)

    def __post_init__(self) -> None:
        """Divide the weights between Muon, which takes matrices only, and AdamW."""
        import torch

        table = self.text.shared.weight
        weights = [p for net in (self.dit, self.text, self.image) for p in net.parameters()]
        self.matrices = [
            (p, p.detach().squeeze(0).flatten(1)) for p in weights if p.ndim > 1 and p is not table
        ]
        rest = [p for p in weights if p.ndim == 1 or p is table]
        flat = [matrix for _, matrix in self.matrices]
        self.rules = (
            torch.optim.Muon(flat, LEARNING_RATE, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
            torch.optim.AdamW(rest, LEARNING_RATE, weight_decay=0.0, fused=True),
        )

    def step(self) -> tuple[float, float]:
        """Forward, backward, update."""
        for parameter in self._parameters():
            parameter.grad = None
        loss = self._loss()
        loss.backward()
        start = time.perf_counter()
        norm = self._update()
        self.updating.append(time.perf_counter() - start)
        return loss.item(), norm.item()

    def _loss(self) -> torch.Tensor:
        import torch

        x = self.inputs
        text = self.text(x["ids"], x["ids_mask"]).last_hidden_state * x["ids_mask"][..., None]
        image = self.image(x["pixels"]).last_hidden_state
        sigma = x["sigma"][:, None, None, None, None]
        noisy = (1 - sigma) * x["target"] + sigma * x["noise"]
        seen = x["prior"] * (1 - x["mask"][:, :1])
        channels = torch.cat([noisy, x["mask"], seen, x["hands"]], dim=1)
        velocity = self.dit(channels, x["time"], text, image, return_dict=False)[0]
        return (velocity - (x["noise"] - x["target"])).square().mean()

    def _update(self) -> torch.Tensor:
        import torch

        norm = torch.nn.utils.clip_grad_norm_(self._parameters(), 1.0)
        for parameter, matrix in self.matrices:
            matrix.grad = parameter.grad.squeeze(0).flatten(1)
        for rule in self.rules:
            rule.step()
        return norm

    def _parameters(self) -> Iterable[torch.nn.Parameter]:
        return (p for net in (self.dit, self.text, self.image) for p in net.parameters())


@dataclass(frozen=True)
class CrossAttention:
    """Attention to the image and to the text; diffusers' own counts on 512 tokens of text."""

    image_tokens: int

    def __call__(
        self,
        attn: Any,
        hidden_states: torch.Tensor,
        encoder_hidden_states: torch.Tensor,
        attention_mask: None = None,
        rotary_emb: None = None,
    ) -> torch.Tensor:
        from einops import rearrange
        from torch.nn.functional import scaled_dot_product_attention

        def split(x: torch.Tensor) -> torch.Tensor:
            return rearrange(x, "b n (h k) -> b h n k", h=attn.heads)

        image = encoder_hidden_states[:, : self.image_tokens]
        text = encoder_hidden_states[:, self.image_tokens :]
        query = split(attn.norm_q(attn.to_q(hidden_states)))
        key, value = attn.norm_k(attn.to_k(text)), attn.to_v(text)
        attended = scaled_dot_product_attention(query, split(key), split(value))
        key, value = attn.norm_added_k(attn.add_k_proj(image)), attn.add_v_proj(image)
        attended = attended + scaled_dot_product_attention(query, split(key), split(value))
        return attn.to_out[0](rearrange(attended, "b h n k -> b n (h k)"))


def _channels_first(batch: Batch, config: ModelConfig) -> dict[str, torch.Tensor]:
    import torch
    from einops import rearrange

    layout = {4: "b h w c -> b c h w", 5: "b f h w c -> b c f h w"}
    arrays = {
        name: rearrange(array, layout[array.ndim]) if array.ndim in layout else array
        for name, array in batch.items()
    }
    arrays["mask"] = arrays["mask"].astype(np.float32)
    arrays["time"] = np.array(config.process.timesteps(batch["sigma"]))
    tensors = {name: torch.tensor(np.ascontiguousarray(array)) for name, array in arrays.items()}
    return {**tensors, "ids": tensors["ids"].long(), "ids_mask": tensors["ids_mask"].long()}


if __name__ == "__main__":
    tyro.cli(main)
