"""Training a denoiser with half of its tokens in most blocks, to measure whether that pays.

As in TREAD (Krause et al. 2025): between the first and the last blocks a random part of the
tokens, the same of all samples of a batch, is left alone, and joins the others again behind them.
No weights are added, and the network is validated and used with all tokens.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from egosim_jax.configs.model import Networks
from egosim_jax.models import remat
from egosim_jax.models.layers import scan_blocks
from egosim_jax.models.wan.causal import whole
from egosim_jax.models.wan.dit import DiTContext, WanDiT
from egosim_jax.models.wan.layers import PATCH
from egosim_jax.train.task import Metrics
from egosim_jax.train.tasks.denoising import Denoising, condition_of, loss_weights


@dataclass(frozen=True, kw_only=True)
class Routing(Denoising):
    """The task of training the denoiser with some of its tokens routed past the middle blocks."""

    kept: float = 0.5
    """Share of the tokens that take part in the middle blocks."""
    before: int = 1
    """Blocks before the route, which all tokens pass."""
    behind: int = 1
    """Blocks behind the route, which all tokens pass."""

    def loss(
        self, networks: Networks, batch: Mapping[str, Array], keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the diffusion loss of a batch under condition dropout and routing."""
        condition = self.dropout.apply(condition_of(networks, batch, self.model), keys[:, 0])
        target, dit = batch["target"], networks.dit
        channels = self.model.layout.condition_channels(condition, target)
        context = dit.prepare(channels, condition.text, condition.image)
        tokens = context.patches.shape[1]
        order = jax.random.permutation(jax.random.fold_in(keys[0, 1], 1), tokens)
        routed = order[: round(self.kept * tokens)]
        weights = loss_weights(target, batch.get("prior", target), self.change_loss_weight)
        loss, _ = self.objective.loss(
            self.model.process,
            lambda x, t: self._denoise(dit, x, t, context, routed),
            target,
            keys[:, 1],
            loss_weights=weights,
        )
        return loss, {}

    def _denoise(
        self,
        dit: WanDiT,
        noisy: Float[Array, "b f h w c"],
        t: Float[Array, " b"],
        context: DiTContext,
        routed: Int[Array, " k"],
    ) -> Float[Array, "b f h w c"]:
        """Return what `WanDiT.denoise` does, by parts of its blocks."""
        time, modulation = dit.time(t[:, None])
        x = dit.patch.noisy(noisy) + context.patches
        last = dit.config.layers - self.behind
        x = _through(dit, x, modulation, context, slice(0, self.before))
        some = replace(context, rotation=context.rotation[routed])
        part = _through(dit, x[:, routed], modulation, some, slice(self.before, last))
        x = x.at[:, routed].set(part)
        x = _through(dit, x, modulation, context, slice(last, None))
        _, _, h, w, _ = noisy.shape
        return rearrange(
            dit.head(x, time),
            "b (f h w) (i j c) -> b f (h i) (w j) c",
            h=h // PATCH,
            w=w // PATCH,
            i=PATCH,
            j=PATCH,
        )


def _through(
    dit: WanDiT,
    x: Float[Array, "b n d"],
    modulation: Float[Array, "b g 6 d"],
    context: DiTContext,
    layers: slice,
) -> Float[Array, "b n d"]:
    """Pass tokens through some of the blocks."""
    graph, state = nnx.split(dit.blocks)
    part = nnx.merge(graph, jax.tree.map(lambda leaf: leaf[layers], state))
    sources = jax.tree.map(lambda leaf: leaf[layers], context.sources)

    attend = whole(dit.config.attention)

    def step(block: Any, x: jax.Array, sources: Any) -> tuple[jax.Array, None]:
        return block(x, modulation, context.rotation, sources, attend)

    x, _ = scan_blocks(step, part, x, sources, remat=remat.wrapper(dit.config.remat))
    return x
