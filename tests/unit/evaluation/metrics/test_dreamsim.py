"""DreamSim versus transformers' networks on random weights in the layout of its release."""

import json
import shutil

import numpy as np
import pytest
import torch
import transformers as hf
from PIL import Image

from egosim_jax.evaluation.metrics.dreamsim import BACKBONES, DreamSim
from egosim_jax.types import InputError

DIM, DEPTH, RANK, ALPHA, SIZE, PATCH = 64, 2, 4, 2.0, 32, 16
COLORS = [torch.tensor(backbone.colors)[..., None, None] for backbone in BACKBONES]
SIZES = {
    "hidden_size": DIM, "num_hidden_layers": DEPTH, "num_attention_heads": 1,
    "intermediate_size": 2 * DIM, "image_size": SIZE, "patch_size": PATCH,
}  # fmt: skip


def dino():
    config = hf.ViTConfig(**SIZES, layer_norm_eps=1e-6, hidden_act="gelu")
    return hf.ViTModel(config, add_pooling_layer=False)


def clip(activation):
    config = hf.CLIPVisionConfig(**SIZES, projection_dim=24, hidden_act=activation)
    return hf.CLIPVisionModelWithProjection(config)


def to_release(state):
    """Return the weights of a transformer of transformers under the names of DreamSim's files."""
    found, layers = {}, {}
    for name, value in state.items():
        parts = name.split(".")
        if "layer" in parts or "layers" in parts:
            place = parts.index("layer" if "layer" in parts else "layers")
            layers.setdefault(parts[place + 1], {})[".".join(parts[place + 2 :])] = value
    for number, layer in layers.items():

        def pick(*ends, layer=layer):
            return next(v for k, v in layer.items() if k.endswith(ends))

        for kind in ("weight", "bias"):
            block = f"blocks.{number}"
            found[f"{block}.attn.qkv.{kind}"] = torch.cat([
                pick(f"query.{kind}", f"q_proj.{kind}"), pick(f"key.{kind}", f"k_proj.{kind}"),
                pick(f"value.{kind}", f"v_proj.{kind}"),
            ])  # fmt: skip
            found[f"{block}.attn.proj.{kind}"] = pick(
                f"attention.output.dense.{kind}", f"out_proj.{kind}", f"o_proj.{kind}"
            )
            for ours, theirs in {
                "norm1": ("layernorm_before", "layer_norm1"),
                "norm2": ("layernorm_after", "layer_norm2"),
                "mlp.fc1": ("intermediate.dense", "fc1"),
            }.items():
                found[f"{block}.{ours}.{kind}"] = pick(*(f"{name}.{kind}" for name in theirs))
            last = {k: v for k, v in layer.items() if "attention" not in k}
            found[f"{block}.mlp.fc2.{kind}"] = next(
                v for k, v in last.items() if k.endswith((f"output.dense.{kind}", f"fc2.{kind}"))
            )
    return found


def rest_of(state, *, clip):
    def pick(end):
        return next(v for k, v in state.items() if k.endswith(end))

    if not clip:
        names = {"patch_embed.proj": "patch_embeddings.projection", "norm": "layernorm"}
        found = {f"{a}.{k}": pick(f"{b}.{k}") for a, b in names.items() for k in ("weight", "bias")}
        return found | {
            "cls_token": pick("cls_token"), "pos_embed": pick("position_embeddings"),
        }  # fmt: skip
    names = {"pos_drop": "pre_layrnorm", "norm": "post_layernorm"}
    found = {f"{a}.{k}": pick(f"{b}.{k}") for a, b in names.items() for k in ("weight", "bias")}
    return found | {
        "patch_embed.proj.weight": pick("patch_embedding.weight"),
        "patch_embed.proj.bias": torch.zeros(DIM),
        "cls_token": pick("class_embedding")[None, None],
        "pos_embed": pick("position_embedding.weight")[None],
        "proj": pick("visual_projection.weight").T.contiguous(),
    }


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Folder in the layout of the release, and the networks with the LoRA added."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("dreamsim")
    (folder / "checkpoints").mkdir()
    (folder / "ensemble_lora").mkdir()
    networks, lora = [dino().eval(), clip("quick_gelu").eval(), clip("gelu").eval()], {}
    for number, (backbone, network) in enumerate(zip(BACKBONES, networks, strict=True)):
        for value in network.state_dict().values():
            if value.is_floating_point():
                value.copy_(torch.randn_like(value) * 0.2)
        state = network.state_dict()
        weights = {**to_release(state), **rest_of(state, clip=backbone.projected)}
        torch.save({"state_dict": weights} if backbone.projected else weights,
                   folder / backbone.file)  # fmt: skip
        for layer in range(DEPTH):
            down, up = torch.randn(RANK, DIM) * 0.1, torch.randn(3 * DIM, RANK) * 0.1
            name = f"base_model.model.extractor_list.{number}.model.blocks.{layer}.attn.qkv"
            lora |= {f"{name}.lora_A.weight": down, f"{name}.lora_B.weight": up}
            parts = (ALPHA / RANK * up @ down).chunk(3)
            modules = dict(network.named_modules())
            for ends, part in zip((("query", "q_proj"), ("key", "k_proj"), ("value", "v_proj")),
                                  parts, strict=True):  # fmt: skip
                (linear,) = [m for n, m in modules.items()
                             if n.endswith(ends) and f".{layer}." in n]  # fmt: skip
                linear.weight.data += part
    torch.save(lora, folder / "ensemble_lora" / "adapter_model.bin")
    config = {"r": RANK, "lora_alpha": ALPHA, "target_modules": ["qkv"]}
    (folder / "ensemble_lora" / "adapter_config.json").write_text(json.dumps(config))
    return folder, networks


def expected(networks, a, b):
    """Return the distances of frames by transformers, as the package defines them."""
    embedded = []
    for frames in (a, b):
        images = [Image.fromarray(x).resize((SIZE, SIZE), Image.Resampling.BICUBIC) for x in frames]
        x = torch.from_numpy(np.stack(images)).movedim(-1, 1) / 255
        tokens = []
        with torch.inference_mode():
            for backbone, network, (mean, std) in zip(BACKBONES, networks, COLORS, strict=True):
                if backbone.projected:
                    tokens.append(network((x - mean) / std).image_embeds)
                else:
                    output = network((x - mean) / std, output_hidden_states=True)
                    tokens.append(output.hidden_states[-1][:, 0])
        joined = torch.cat(tokens, dim=1)
        embedded.append(joined - joined.mean(dim=1, keepdim=True))
    return (1 - torch.cosine_similarity(*embedded)).numpy()


def test_distances_are_those_of_transformers(release):
    folder, networks = release
    a, b = np.random.default_rng(0).integers(0, 256, (2, 3, 40, 56, 3)).astype(np.uint8)
    network = DreamSim(folder)
    found = network.distances(network.embed(a), network.embed(b))
    np.testing.assert_allclose(found, expected(networks, a, b), atol=2e-5)
    assert found.min() > 1e-3
    assert network.distances(network.embed(a), network.embed(a)) == pytest.approx(0, abs=1e-6)


def test_a_folder_without_a_network_is_refused(release, tmp_path):
    folder, _ = release
    (tmp_path / "ensemble_lora").symlink_to(folder / "ensemble_lora")
    with pytest.raises(InputError, match=r"clip_vitb16_pretrain\.pth\.tar.*v0\.2\.0-checkpoints"):
        DreamSim(tmp_path)
    with pytest.raises(InputError, match=r"adapter_config\.json"):
        DreamSim(tmp_path / "none")


@pytest.mark.parametrize("rank", ["0", "NaN", "null", '"16"'])
def test_a_lora_without_a_valid_rank_is_refused(release, tmp_path, rank):
    folder, _ = release
    for path in folder.iterdir():
        if path.name != "ensemble_lora":
            (tmp_path / path.name).symlink_to(path)
    shutil.copytree(folder / "ensemble_lora", tmp_path / "ensemble_lora")
    config = tmp_path / "ensemble_lora" / "adapter_config.json"
    config.write_text(f'{{"r": {rank}, "lora_alpha": 16}}')
    with pytest.raises(InputError, match="as r: r and lora_alpha must be positive"):
        DreamSim(tmp_path)


def test_a_lora_of_other_networks_is_refused(release, tmp_path):
    folder, _ = release
    for name in ("checkpoints", *(b.file for b in BACKBONES[1:])):
        (tmp_path / name).symlink_to(folder / name)
    (tmp_path / "ensemble_lora").mkdir()
    config = (folder / "ensemble_lora" / "adapter_config.json").read_text()
    (tmp_path / "ensemble_lora" / "adapter_config.json").write_text(config)
    name = "base_model.model.extractor_list.0.model.blocks.0.attn.qkv"
    lora = {f"{name}.lora_A.weight": torch.zeros(4, 9), f"{name}.lora_B.weight": torch.zeros(27, 4)}
    torch.save(lora, tmp_path / "ensemble_lora" / "adapter_model.bin")
    with pytest.raises(InputError, match="does not fit"):
        DreamSim(tmp_path)
