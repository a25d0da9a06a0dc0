"""One update of the `tabletop` denoiser: its predicted and its measured memory.

Prints both, in bytes. Both begin with the weights, moments and batch.
"""

import ctypes
import gc
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from egosim_jax.preflight.targets import compile_offline, find
from egosim_jax.sharding import batch_sharding, make_mesh
from egosim_jax.train.preflight import compile_step
from egosim_jax.train.recipes import TABLETOP
from egosim_jax.train.update import Programs


def resident(name: str) -> int:
    """Bytes that the kernel counts for this process: VmRSS now, VmHWM at its peak."""
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    (line,) = (line for line in lines if line.startswith(name))
    return int(line.split()[1]) * 1024


def main() -> None:
    compile_offline()
    stage, target = TABLETOP.stages()["denoiser"], find("cpu:1")
    task, training = stage
    predicted = compile_step(stage, target).memory.peak
    mesh = make_mesh(training.mesh, target.devices)
    programs, placed = Programs.of(task, training, mesh), batch_sharding(mesh)
    with jax.set_mesh(mesh):
        shapes = task.shapes(training.batch_size)

        def make_batch() -> dict[str, jax.Array]:
            """Put a batch of zeros on the device."""
            return {
                name: jax.device_put(np.zeros(leaf.shape, leaf.dtype), placed)
                for name, leaf in shapes.items()
            }

        update = programs.update.lower(programs.state, programs.frozen, shapes).compile()
        zeros = jax.jit(
            lambda: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), programs.state),
            out_shardings=programs.state_sharding,
        )
        zeros = zeros.lower().compile()
        batch = make_batch()
        # What compiling left behind, and the buffers that libraries keep after a first update,
        # would be counted as the update's.
        jax.block_until_ready(update(zeros(), programs.frozen, batch))
        del batch
        gc.collect()
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        before = resident("VmRSS")
        batch = make_batch()
        state = jax.block_until_ready(zeros())
        Path("/proc/self/clear_refs").write_text("5")  # VmHWM begins again
        jax.block_until_ready(update(state, programs.frozen, batch))
    print(json.dumps({"predicted": predicted, "measured": resident("VmHWM") - before}))


if __name__ == "__main__":
    main()
