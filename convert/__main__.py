"""Command line of `egosim-convert`: conversion of PyTorch checkpoints to weights and back."""

from __future__ import annotations

from egosim_jax.runtime import interrupts

interrupts.expect()

import sys
from collections.abc import Sequence

from egosim_jax.convert.commands import Inspect, Lora, ToTorch, Weights
from egosim_jax.convert.quantize import Quantize
from egosim_jax.convert.verify import Verify
from egosim_jax.runtime import command

Commands = command.subcommands(
    {
        "inspect": Inspect,
        "weights": Weights,
        "lora": Lora,
        "quantize": Quantize,
        "to-torch": ToTorch,
        "verify": Verify,
    }
)


def main(args: Sequence[str] | None = None, *, program: str = "egosim-convert") -> int:
    """Run `egosim-convert` and return its exit code."""
    return command.main(
        Commands,
        program=program,
        description="Convert weights and LoRAs from and to PyTorch checkpoints.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
