"""One forward of a converted network beside PyTorch's, which reads the checkpoint by itself.

PyTorch's networks are those of diffusers and transformers. Of the released names diffusers knows
the video transformer's and the VAE's; umT5's and CLIP's are brought into transformers' by our own
tables, so that for these two the forward checks sizes and arithmetic, but not names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from einops import rearrange

from egosim_jax.convert.layouts import Found, naming_in
from egosim_jax.convert.plan import BASE_CHANNELS, MASK, Widening, to_theirs
from egosim_jax.convert.skeleton import skeleton
from egosim_jax.convert.theirs import arguments
from egosim_jax.generator import Program
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.config import WanDiTConfig
from egosim_jax.models.wan.umt5 import UMT5Config
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.networks import ModelConfig
from egosim_jax.types import InputError

LAYERS, VOCAB = 2, 512
"""Layers and rows of the token table that are computed: the others' values are compared anyway."""
TOLERANCE = 1e-4
"""Relative L2 in float32 of two layers, or of the VAE's whole encoder and decoder."""
TEXT_TOKENS, IMAGE_TOKENS = 512, 257
"""diffusers' transformer parts the two by these numbers."""
RES_BLOCKS = 2
"""Of a level of the released VAE's encoder."""
UNUSED = "post_layernorm"
"""What follows the last block that we use of CLIP, and may be missing."""
MODULES = ("torch", "diffusers", "transformers")
"""What it takes; the extra `test` has them."""


def possible() -> bool:
    """Whether the libraries that it takes are installed."""
    return all(find_spec(name) for name in MODULES)


def difference(
    found: Found, file: Path, config: ModelConfig, *, widen: Widening | None = None
) -> float:
    """Relative L2 between the outputs of the converted file and of the checkpoint, in float32.

    Both get the same random input. The checkpoint is first cast as the file was.
    """
    import jax

    converted = read_safetensors(file)
    shape = _short(getattr(config, found.network))
    ours = skeleton(found.network, shape)
    fill(ours, {p: _values(converted[p].array(), s) for p, s in flat_shapes(ours).items()})
    stored = {tensor.dtype for tensor in converted.values()}
    theirs = _Theirs(
        _arrays(found, config, converted), cast=stored.pop() if len(stored) == 1 else None
    )
    with jax.default_matmul_precision("highest"):
        if found.network == "dit":
            have, want = _dit(ours, shape, theirs, widen)
        else:
            have, want = {"vae": _vae, "text": _text, "image": _image}[found.network](
                ours, shape, theirs
            )
    return float(np.linalg.norm(have - want) / np.linalg.norm(want))


def _run(network: Any, *inputs: Any) -> np.ndarray:
    """What a network gives."""
    return np.asarray(Program(lambda network, *x: network(*x), network)(*inputs))


class _Theirs:
    """A checkpoint in the names of diffusers or transformers."""

    def __init__(self, arrays: Mapping[str, Callable[[], np.ndarray]], cast: np.dtype | None):
        self.arrays, self.cast = arrays, cast

    def load(self, module: Any) -> Any:
        """Fill a module of PyTorch's. Raises `InputError` naming what the checkpoint lacks."""
        import torch

        state, lacking = {}, []
        for name, parameter in module.named_parameters():
            read = self.arrays.get(name.removeprefix("vision_model."))
            if read is not None:
                values = _values(read(), tuple(parameter.shape), cast=self.cast)
                state[name] = torch.from_numpy(values)
            elif UNUSED not in name:
                lacking.append(name)
        if lacking:
            raise InputError(f"The checkpoint has no {', '.join(lacking)}, which PyTorch needs.")
        module.load_state_dict(state, strict=False)
        return module.eval()


def _short(shape: Any) -> Any:
    """The network's config with fewer layers and tokens, in float32."""
    shape = replace(shape, dtype="float32")
    if isinstance(shape, WanDiTConfig | UMT5Config):
        shape = replace(shape, layers=min(LAYERS, shape.layers))
    if isinstance(shape, UMT5Config):
        shape = replace(shape, vocab=min(VOCAB, shape.vocab))
    if isinstance(shape, CLIPVisionConfig):
        shape = replace(shape, layers=min(LAYERS, shape.blocks), skip_last=0)
    return shape


def _values(array: np.ndarray, shape: tuple[int, ...], cast: np.dtype | None = None) -> np.ndarray:
    """The first values along each axis, in float32."""
    if array.ndim != len(shape) or any(n < m for n, m in zip(array.shape, shape, strict=True)):
        raise InputError(f"The checkpoint has {array.shape} where PyTorch needs {shape}.")
    part = array[tuple(map(slice, shape))]
    return np.array(part if cast is None else part.astype(cast), np.float32)


def _arrays(
    found: Found, config: ModelConfig, converted: Mapping[str, Tensor]
) -> Mapping[str, Callable[[], np.ndarray]]:
    """What reads each tensor of the checkpoint, in the names of diffusers or transformers."""
    arrays = {name: tensor.array for name, tensor in found.tensors.items()}
    if found.naming != "wan":
        return arrays
    from diffusers.loaders import single_file_utils

    if found.network == "dit":
        return single_file_utils.convert_wan_transformer_to_diffusers(arrays)
    # Its VAE's names are written out for the released one's blocks.
    if found.network == "vae" and config.vae.res_blocks == RES_BLOCKS:
        return single_file_utils.convert_wan_vae_to_diffusers(arrays)
    theirs = to_theirs(converted, config, found.network, naming_in("diffusers", found.network))
    return {weight.name: weight.pieces[0] for weight in theirs}


def _dit(
    ours: Any, shape: WanDiTConfig, theirs: _Theirs, widen: Widening | None
) -> tuple[np.ndarray, np.ndarray]:
    """The velocities of one small clip."""
    import torch
    from diffusers import WanTransformer3DModel

    draw = np.random.default_rng(0).standard_normal
    channels = BASE_CHANNELS if widen else shape.in_channels
    module = WanTransformer3DModel(**arguments("dit", replace(shape, in_channels=channels)))
    latents = draw((1, 2, 8, 8, shape.in_channels), np.float32)
    text = draw((1, TEXT_TOKENS, shape.text_dim), np.float32)
    image = shape.image_dim and draw((1, IMAGE_TOKENS, shape.image_dim), np.float32)
    t = np.full(1, 500, np.float32)
    have = _run(ours, latents, t, text, image)
    seen = latents[..., :channels].copy()
    if widen == "polarity":
        seen[..., MASK] = 1 - seen[..., MASK]
    with torch.no_grad():
        velocity = theirs.load(module)(
            torch.from_numpy(rearrange(seen, "b f h w c -> b c f h w").copy()),
            torch.from_numpy(t),
            torch.from_numpy(text),
            None if image is None else torch.from_numpy(image),
            return_dict=False,
        )[0]
    return have, rearrange(velocity.numpy(), "b c f h w -> b f h w c")


def _vae(ours: Any, shape: WanVAEConfig, theirs: _Theirs) -> tuple[np.ndarray, np.ndarray]:
    """A small video, encoded and decoded."""
    import torch
    from diffusers import AutoencoderKLWan

    module = AutoencoderKLWan(**arguments("vae", shape))
    theirs.load(module)
    video = np.random.default_rng(0).uniform(-1, 1, (1, 5, 32, 32, 3)).astype(np.float32)
    have = Program(lambda vae, x: vae.decode(vae.encode(x)), ours)(video)
    with torch.no_grad():
        seen = torch.from_numpy(rearrange(video, "b f h w c -> b c f h w").copy())
        (posterior,) = module.encode(seen, return_dict=False)
        (decoded,) = module.decode(posterior.mode(), return_dict=False)
    return np.asarray(have), rearrange(decoded.numpy(), "b c f h w -> b f h w c")


def _text(ours: Any, shape: UMT5Config, theirs: _Theirs) -> tuple[np.ndarray, np.ndarray]:
    """The embeddings of random tokens."""
    import torch
    from transformers import UMT5Config as TheirConfig
    from transformers import UMT5EncoderModel

    config = TheirConfig(**arguments("text", shape))
    ids = np.random.default_rng(0).integers(0, shape.vocab, (1, TEXT_TOKENS // 4), np.int32)
    mask = np.ones(ids.shape, bool)
    have = _run(ours, ids, mask)
    with torch.no_grad():
        module = theirs.load(UMT5EncoderModel(config))
        want = module(torch.from_numpy(ids).long(), torch.from_numpy(mask).long())
    return have, want.last_hidden_state.numpy()


def _image(ours: Any, shape: CLIPVisionConfig, theirs: _Theirs) -> tuple[np.ndarray, np.ndarray]:
    """The tokens of a random picture."""
    import torch
    from transformers import CLIPVisionConfig as TheirConfig
    from transformers import CLIPVisionModel

    config = TheirConfig(**arguments("image", shape))
    size = (1, shape.image_size, shape.image_size, 3)
    pixels = np.random.default_rng(0).standard_normal(size, np.float32)
    have = _run(ours, pixels)
    with torch.no_grad():
        seen = torch.from_numpy(rearrange(pixels, "b h w c -> b c h w").copy())
        states = theirs.load(CLIPVisionModel(config))(seen, output_hidden_states=True)
    return have, states.hidden_states[-1].numpy()
