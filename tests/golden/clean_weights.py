"""Clean checkpoints and LoRAs in the names of their projects."""

import json

import numpy as np
from safetensors.numpy import load_file, save_file

from egosim_jax import configs
from egosim_jax.convert.__main__ import main as convert
from egosim_jax.convert.lora import read_lora
from egosim_jax.convert.tables import table_of, weight_shapes
from tests.golden import fingerprints as fp
from tests.golden.fingerprints import clean
from tests.translation import translate_back

CONFIG = configs.get("debug")


def values(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Numbers whose products and sums of a few are exact in float32."""
    return (((np.arange(np.prod(shape)) + 37 * seed) % 251 - 125) / 256).reshape(shape).astype("f4")


@clean("checkpoint as published", "wan", "wan")
@clean("checkpoint of diffusers", "diffusers", "transformers")
def checkpoint(folder, naming, text_naming):
    parts = {}
    for number, (network, config) in enumerate(CONFIG.networks.items()):
        ours = {path: values(s, number) for path, s in weight_shapes(config).items()}
        chosen = naming if network in ("dit", "vae") else text_naming
        parts[network] = translate_back(ours, table_of(config).rules(chosen, config))
    prefix = "vision_model." if naming == "diffusers" else ""
    parts["image"] = {prefix + name: tensor for name, tensor in parts["image"].items()}
    (folder / "theirs").mkdir()
    for network, tensors in parts.items():
        exact = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
        save_file(exact, folder / f"theirs/{network}.safetensors")
    command = ["weights", str(folder / "theirs"), "--config", "debug", "--out", str(folder / "out")]
    for name, options in {"as it is": (), "bfloat16": ("--dtype", "bfloat16")}.items():
        assert convert([*command[:-1], str(folder / name), *options]) == 0
        for path in sorted((folder / name).glob("[!.]*")):
            yield f"{name}, {path.name}", fp.bits(load_file(path))


@clean("LoRA of ComfyUI", "diffusion_model.{}", ("lora_A", "lora_B"), "alpha")
@clean("LoRA of musubi", "lora_unet_{}", ("lora_down", "lora_up"), "alpha")
@clean("LoRA of PEFT", "base_model.model.{}", ("lora_A", "lora_B"), "config")
@clean("LoRA of diffusers", "transformer.{}", ("lora_A", "lora_B"), "none")
def lora(folder, base, ends, scale):
    dim, ffn = CONFIG.dit.dim, CONFIG.dit.ffn_dim
    layers = {"blocks.0.self_attn.q": (dim, dim), "blocks.1.self_attn.q": (dim, dim),
              "blocks.1.ffn.0": (ffn, dim), "blocks.0.cross_attn.v_img": (dim, dim)}  # fmt: skip
    theirs = {"self_attn.q": "attn1.to_q", "ffn.0": "ffn.net.0.proj",
              "cross_attn.v_img": "attn2.add_v_proj"}  # fmt: skip
    tensors = {}
    for number, (name, (out, wide)) in enumerate(layers.items()):
        written = name.replace(".", "_") if "unet" in base else name
        if scale == "none":
            start, end = name[:9], name[9:]
            written = start + theirs[end]
        key = base.format(written)
        tensors[f"{key}.{ends[0]}.weight"] = values((2, wide), number)
        tensors[f"{key}.{ends[1]}.weight"] = values((out, 2), number + 1)
        if scale == "alpha":
            tensors[f"{key}.alpha"] = np.array(4, np.float32)
    source = folder / "theirs"
    source.mkdir()
    save_file(tensors, source / "adapter_model.safetensors")
    if scale == "config":
        about = {"peft_type": "LORA", "r": 2, "lora_alpha": 4, "target_modules": list(layers),
                 "bias": "none", "use_dora": False, "use_rslora": False, "rank_pattern": {},
                 "alpha_pattern": {}, "init_lora_weights": True}  # fmt: skip
        (source / "adapter_config.json").write_text(json.dumps(about), "utf-8")
    else:
        source = source / "adapter_model.safetensors"
    out = folder / "out.safetensors"
    assert convert(["lora", str(source), "--config", "debug", "--out", str(out)]) == 0
    for path, change in sorted(read_lora(out, CONFIG.dit).items()):
        yield path, fp.bits({"change": change.down @ change.up})
