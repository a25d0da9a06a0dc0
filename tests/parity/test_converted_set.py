"""A whole model as others save it, converted, against the modules that saved it.

The networks form a tiny Wan 2.1 image-to-video model with random weights: saved by
diffusers and transformers themselves, or in the files of the Wan release. Converted and widened to
52 channels, whose kernel for the hands is 0, they denoise and decode as the originals do.
"""

import jax
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLWan, FlowMatchEulerDiscreteScheduler, WanTransformer3DModel
from einops import rearrange
from safetensors.torch import save_file
from transformers import CLIPVisionConfig as TheirCLIP
from transformers import CLIPVisionModel, UMT5EncoderModel
from transformers import UMT5Config as TheirUMT5

from egosim_jax import configs
from egosim_jax.conditioning.text import BYT5_VOCAB, PromptTokenizer
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.tables import clip_vision, umt5, wan_dit, wan_vae
from egosim_jax.diffusion.process import RectifiedFlow
from egosim_jax.generation.encoding import encode_condition, pack
from egosim_jax.generation.generator import Generator
from egosim_jax.models.t5 import UMT5Config
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.types import Triplet, VideoSpec
from tests.translation import translate, translate_back

TOLERANCE = 1e-5
"""Relative L2 of the latents in float32 after all networks and ten steps."""
CONFIG = ModelConfig(
    name="fun",
    video=VideoSpec(frames=5, height=32, width=48, fps=16),
    dit=WanDiTConfig(dim=128, heads=2, ffn_dim=192, layers=2, text_dim=64, image_dim=32),
    vae=WanVAEConfig(dim=8),
    text=UMT5Config(vocab=BYT5_VOCAB, dim=64, ffn_dim=96, heads=4, head_dim=16, layers=2),
    image=CLIPVisionConfig(image_size=224, patch=14, dim=32, layers=2, heads=2, ffn_dim=64),
    # diffusers takes the last 512 tokens for text and the 257 before them for the image.
    tokenizer=PromptTokenizer(max_tokens=512),
    process=RectifiedFlow(shift=3.0),
    steps=10,
)
encode = jax.jit(encode_condition)


@pytest.fixture(scope="module")
def theirs():
    """The four networks, with gains and biases that count."""
    torch.manual_seed(0)
    dit, text, image = CONFIG.dit, CONFIG.text, CONFIG.image
    modules = {
        "dit": WanTransformer3DModel(
            num_attention_heads=dit.heads, attention_head_dim=dit.head_dim, in_channels=36,
            out_channels=16, text_dim=dit.text_dim, ffn_dim=dit.ffn_dim, num_layers=dit.layers,
            cross_attn_norm=True, eps=dit.eps, image_dim=dit.image_dim, added_kv_proj_dim=dit.dim,
        ),
        "vae": AutoencoderKLWan(base_dim=CONFIG.vae.dim, z_dim=CONFIG.vae.z_dim),
        "text": UMT5EncoderModel(
            TheirUMT5(
                vocab_size=text.vocab, d_model=text.dim, d_kv=text.head_dim, d_ff=text.ffn_dim,
                num_layers=text.layers, num_heads=text.heads,
                relative_attention_num_buckets=text.buckets,
                relative_attention_max_distance=text.max_distance, feed_forward_proj="gated-gelu",
            )
        ),
        "image": CLIPVisionModel(
            TheirCLIP(
                hidden_size=image.dim, intermediate_size=image.ffn_dim,
                num_hidden_layers=image.layers, num_attention_heads=image.heads,
                image_size=image.image_size, patch_size=image.patch, layer_norm_eps=image.eps,
                hidden_act="gelu",
            )
        ),
    }  # fmt: skip
    with torch.no_grad():
        for module in modules.values():
            for name, parameter in module.eval().named_parameters():
                if ("norm" in name and name.endswith("weight")) or name.endswith("gamma"):
                    parameter.uniform_(0.5, 1.5)
                elif name.endswith("bias"):
                    parameter.normal_(std=0.1)
    return modules


def saved_by_diffusers(theirs, folder):
    names = {"dit": "transformer", "vae": "vae", "text": "text_encoder", "image": "image_encoder"}
    for network, name in names.items():
        theirs[network].save_pretrained(folder / name)


def saved_as_released(theirs, folder):
    """In the files and names of Wan2.1-Fun-InP."""

    def renamed(network, table, naming, shape):
        state = {name: tensor.numpy() for name, tensor in theirs[network].state_dict().items()}
        ours = translate(state, getattr(table, naming)(shape), ignore=table.TABLE.ignored(shape))
        back = translate_back(ours, table.wan(shape))
        return {name: torch.tensor(np.ascontiguousarray(x)) for name, x in back.items()}

    narrow = WanDiTConfig(
        in_channels=36, dim=128, heads=2, ffn_dim=192, layers=2, text_dim=64, image_dim=32
    )
    dit = renamed("dit", wan_dit, "diffusers", narrow)
    save_file(dit, folder / "diffusion_pytorch_model.safetensors")
    vae = renamed("vae", wan_vae, "diffusers", CONFIG.vae)
    torch.save(vae, folder / "Wan2.1_VAE.pth")
    text = renamed("text", umt5, "transformers", CONFIG.text)
    torch.save(text, folder / "models_t5_umt5-xxl-enc-bf16.pth")
    clip = renamed("image", clip_vision, "transformers", CONFIG.image)
    torch.save(clip, folder / "models_clip_open-clip-xlm-roberta-large-vit-huge-14.pth")


@pytest.fixture(scope="module", params=[saved_by_diffusers, saved_as_released])
def converted(request, theirs, tmp_path_factory):
    source, out = (tmp_path_factory.mktemp(name) for name in ("theirs", "ours"))
    request.param(theirs, source)
    patch = pytest.MonkeyPatch()
    with patch.context() as known:
        known.setattr(configs, "get", lambda name: CONFIG)
        args = ["weights", str(source), "--config", "fun", "--widen", "copy", "--out", str(out)]
        assert main(args) == 0
    return Networks.load(CONFIG, out)


@pytest.fixture(scope="module")
def triplet():
    rng = np.random.default_rng(0)
    shape = (CONFIG.video.frames, CONFIG.video.height, CONFIG.video.width)

    def video():
        return rng.integers(0, 256, (*shape, 3), dtype=np.uint8)

    return Triplet(
        video_id="a", prompt="A hand opens a drawer.", prior=video(), hands=video(),
        mask=(255 * rng.integers(0, 2, shape)).astype(np.uint8), first_frame=video()[0],
    )  # fmt: skip


def encoded_by_theirs(theirs, inputs):
    """Text, image and the condition's channels, all channel-first."""
    with torch.no_grad():
        mask = torch.tensor(inputs["ids_mask"].astype(np.int64))
        text = theirs["text"](torch.tensor(inputs["ids"].astype(np.int64)), mask).last_hidden_state
        pixels = torch.tensor(rearrange(inputs["pixels"], "b h w c -> b c h w"))
        image = theirs["image"](pixels, output_hidden_states=True).hidden_states[-2]
        video = rearrange(inputs["prior"] / 127.5 - 1, "b f h w c -> b c f h w")
        prior = torch.tensor(video).float()
        latents = theirs["vae"].encode(prior).latent_dist.mode()
    mean, std = (
        torch.tensor(values).reshape(1, -1, 1, 1, 1)
        for values in (CONFIG.vae.latent_mean, CONFIG.vae.latent_std)
    )
    return text * mask[..., None], image, (latents - mean) / std, mean, std


@pytest.mark.slow
def test_ten_steps_and_the_frames_are_those_of_diffusers(converted, theirs, triplet):
    inputs = pack([triplet], CONFIG)
    generator = Generator(CONFIG, converted)
    noise = np.asarray(generator.noise([3]))
    condition = encode(converted, inputs)
    ours = generator.latents([triplet], [3])

    text, image, _, mean, std = encoded_by_theirs(theirs, inputs)
    channels = np.asarray(CONFIG.layout.condition_channels(condition, condition.prior))
    channels = channels[..., :20]  # mask and prior
    channels = torch.tensor(rearrange(channels, "b f h w c -> b c f h w"))
    scheduler = FlowMatchEulerDiscreteScheduler(shift=CONFIG.process.shift)
    scheduler.set_timesteps(sigmas=np.linspace(1, 0, CONFIG.steps + 1)[:-1])
    x = torch.tensor(rearrange(noise, "b f h w c -> b c f h w"))
    with torch.no_grad():
        for t in scheduler.timesteps:
            velocity = theirs["dit"](
                torch.cat([x, channels], dim=1), t[None], text, image, return_dict=False
            )[0]
            x = scheduler.step(velocity, t, x, return_dict=False)[0]
        video = theirs["vae"].decode(x * std + mean, return_dict=False)[0]
    expected = rearrange(x.numpy(), "b c f h w -> b f h w c")
    error = np.linalg.norm(np.asarray(ours) - expected) / np.linalg.norm(expected)
    assert error <= TOLERANCE
    frames = generator.generate([triplet], [3])[0].frames
    theirs_uint8 = rearrange(video.clamp(-1, 1).numpy(), "1 c f h w -> f h w c") * 127.5 + 127.5
    cut = theirs_uint8 - frames  # frames are cut to whole levels, as the release's are
    assert -0.01 <= cut.min() <= cut.max() <= 1.01


def test_the_conditions_are_those_of_diffusers(converted, theirs, triplet):
    inputs = pack([triplet], CONFIG)
    condition = encode(converted, inputs)
    text, image, latents, *_ = encoded_by_theirs(theirs, inputs)
    for have, want in (
        (condition.text, text.numpy()),
        (condition.image, image.numpy()),
        (condition.prior, rearrange(latents.numpy(), "b c f h w -> b f h w c")),
    ):
        assert np.linalg.norm(np.asarray(have) - want) / np.linalg.norm(want) <= TOLERANCE
