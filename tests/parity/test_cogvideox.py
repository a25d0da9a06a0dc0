"""CogVideoX's transformer, VAE and text encoder versus diffusers and transformers."""

import jax
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from diffusers.pipelines.cogvideo.pipeline_cogvideox import get_resize_crop_region_for_grid
from flax import nnx
from transformers import T5Config as TheirConfig
from transformers import T5EncoderModel

from egosim_jax.convert.rules import assign
from egosim_jax.convert.tables import cogvideox_dit, cogvideox_vae, t5, umt5, weight_shapes
from egosim_jax.io.weights import fill
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.cogvideox.vae import CogVideoXVAEConfig
from egosim_jax.models.t5 import T5Config
from tests.translation import translate

TOLERANCE = 1e-5
"""Relative L2 in float32: the order of sums, which differs between processors (2.2e-6 seen)."""
DIT = CogVideoXDiTConfig(
    dim=96, heads=3, layers=2, text_dim=24, time_dim=40, base_rows=6, base_columns=9
)
VAE = CogVideoXVAEConfig(dims=(8, 8, 12, 16), res_blocks=2, groups=4)
TEXT = T5Config(
    vocab=61, dim=48, ffn_dim=80, heads=4, head_dim=8, layers=3, buckets=8, max_distance=20
)


def randomize(module):
    torch.manual_seed(0)
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if parameter.ndim == 1:
                parameter.uniform_(0.5, 1.5) if name.endswith("weight") else parameter.normal_(
                    0, 0.1
                )
            elif "proj_out" in name or "relative_attention_bias" in name:
                parameter.normal_(0, 0.5)
            else:  # as torch does, which draws at construction, before the seed
                bound = parameter[0].numel() ** -0.5
                parameter.uniform_(-bound, bound)
    return module.eval()


def converted(config, module, rules, ignored=()):
    ours = nnx.eval_shape(lambda: config.build(rngs=nnx.Rngs(0)))
    state = {name: tensor.numpy() for name, tensor in module.state_dict().items()}
    fill(ours, translate(state, rules, ignore=list(ignored)))
    return ours


def relative_error(have, want):
    return np.linalg.norm(np.asarray(have) - want) / np.linalg.norm(want)


def run(call, *inputs):
    with jax.default_matmul_precision("highest"):
        return jax.jit(call, compiler_options={"xla_backend_optimization_level": 0})(*inputs)


@pytest.mark.parametrize(
    ("channels", "rows", "columns"), [(33, 12, 18), (49, 12, 18), (49, 8, 20), (33, 14, 6)]
)
def test_the_transformer_predicts_what_diffusers_does(channels, rows, columns):
    config = CogVideoXDiTConfig(**{**vars(DIT), "in_channels": channels})
    module = randomize(CogVideoXTransformer3DModel(**cogvideox_dit.arguments(config)))
    ours = converted(config, module, cogvideox_dit.diffusers(config))
    draw = np.random.default_rng(0).standard_normal
    latents = draw((2, 3, rows, columns, channels), np.float32)
    text = draw((2, 5, config.text_dim), np.float32)
    t = np.array([999, 417], np.float32)
    grid = rows // 2, columns // 2
    region = get_resize_crop_region_for_grid(grid, config.base_columns, config.base_rows)
    with torch.no_grad():
        want = module(
            torch.tensor(latents).permute(0, 1, 4, 2, 3),
            torch.tensor(text),
            torch.tensor(t).long(),
            image_rotary_emb=get_3d_rotary_pos_embed(config.head_dim, region, grid, 3),
        ).sample
    have = run(ours, latents, t, text)
    assert relative_error(have, want.permute(0, 1, 3, 4, 2).numpy()) <= TOLERANCE


@pytest.fixture(scope="module")
def vaes():
    """Ours, and diffusers' in float64: its rounding in float32 depends on the processor."""
    theirs = randomize(AutoencoderKLCogVideoX(**cogvideox_vae.arguments(VAE)))
    return converted(VAE, theirs, cogvideox_vae.diffusers(VAE)), theirs.double()


@pytest.mark.parametrize("frames", [1, 9, 17, 25])
def test_the_vae_encodes_to_the_moments_of_diffusers(vaes, frames):
    ours, theirs = vaes
    video = np.random.default_rng(0).uniform(-1, 1, (1, frames, 24, 16, 3)).astype(np.float32)
    with torch.no_grad():
        posterior = theirs.encode(torch.tensor(video).double().permute(0, 4, 1, 2, 3)).latent_dist
    for part, want in zip(
        run(ours.moments, video), (posterior.mean, posterior.logvar), strict=True
    ):
        assert relative_error(part, want.permute(0, 2, 3, 4, 1).numpy()) <= TOLERANCE


@pytest.mark.parametrize("frames", [1, 3, 5, 7])
def test_the_vae_decodes_to_the_video_of_diffusers(vaes, frames):
    ours, theirs = vaes
    latents = np.random.default_rng(0).normal(size=(1, frames, 3, 2, 16)).astype(np.float32)
    with torch.no_grad():
        scaled = torch.tensor(latents).double() / VAE.scale
        video = theirs.decode(scaled.permute(0, 4, 1, 2, 3)).sample
    want = video.clamp(-1, 1).permute(0, 2, 3, 4, 1).numpy()
    assert want.shape[1] == 4 * (frames - 1) + 1
    assert relative_error(run(ours.decode, latents), want) <= TOLERANCE


def test_the_text_encoder_embeds_as_transformers_does():
    theirs = randomize(T5EncoderModel(TheirConfig(**umt5.arguments(TEXT))))
    ours = converted(TEXT, theirs, t5.transformers(TEXT), t5.TABLE.ignored(TEXT))
    ids = np.random.default_rng(0).integers(0, TEXT.vocab, (3, 40), np.int32)
    with torch.no_grad():
        want = theirs(torch.tensor(ids).long()).last_hidden_state.numpy()
    assert relative_error(run(ours, ids, np.zeros(ids.shape, bool)), want) <= TOLERANCE


@pytest.mark.parametrize(
    ("config", "module", "table"),
    [
        (CogVideoXDiTConfig(), CogVideoXTransformer3DModel, cogvideox_dit),
        (CogVideoXDiTConfig(in_channels=49), CogVideoXTransformer3DModel, cogvideox_dit),
        (CogVideoXVAEConfig(), AutoencoderKLCogVideoX, cogvideox_vae),
    ],
)
def test_names_and_shapes_at_full_size_are_those_of_diffusers(config, module, table):
    with torch.device("meta"):
        state = module(**table.arguments(config)).state_dict()
    zeros = {name: np.broadcast_to(np.float32(0), tuple(x.shape)) for name, x in state.items()}
    leaves = assign(zeros, table.diffusers(config), want=weight_shapes(config))
    assert leaves.keys() == weight_shapes(config).keys()


def test_the_released_size_has_the_published_numbers_of_parameters():
    count = sum(int(np.prod(shape)) for shape in weight_shapes(CogVideoXDiTConfig()).values())
    assert count == pytest.approx(5.57e9, rel=1e-3)
    shapes = weight_shapes(CogVideoXDiTConfig(in_channels=49))
    patch = [int(np.prod(shape)) for path, shape in shapes.items() if path.startswith("patch.")]
    assert sum(patch) == 605_184
