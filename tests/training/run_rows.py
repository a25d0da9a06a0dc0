"""Trainings on several meshes, one after the other, as one process of several.

OUT CASES, a JSON file of lists of `Case` fields. Of a case named a, OUT/a is the run folder, and
OUT/a.npz has the records and inputs of each batch that was put on the devices, and the weights.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import numpy as np
from flax import nnx
from jax.experimental import mesh_utils, multihost_utils

from egosim_jax.generation.generator import Generator
from egosim_jax.sharding import make_mesh
from egosim_jax.testing import random_triplet
from egosim_jax.train.config import OptimizerConfig
from egosim_jax.train.distributed import distributed_context, free_local_address
from egosim_jax.train.loop import Run, train
from egosim_jax.train.monitor import Samples
from egosim_jax.types import MeshConfig
from tests import flags
from tests.training import line, run_tiny

ROOT = Path(__file__).parents[2]
STEPS, SAVE_EVERY = 5, 3


@dataclass(frozen=True)
class Case:
    """A training on a mesh."""

    name: str
    data: str
    mesh: tuple[int, int, int] = (1, -1, 1)
    """Sizes of data, fsdp and context."""
    order: str = "in order"
    """Order of the devices in the mesh.

    Interleaved: the first device of each process, then the second. Scattered: any, so that
    processes may share a part of their rows."""
    parts: int = 1
    """Number of gradient accumulation steps."""
    weights: str | None = None
    """Folder of a tiny model to train instead of a line; it has the weights of the autoencoder."""

    @property
    def config(self) -> MeshConfig:
        return MeshConfig(**dict(zip(("data", "fsdp", "context"), self.mesh, strict=True)))


@contextmanager
def arranged(order: str):
    """Arrange the devices of meshes as on machines whose processes have no consecutive rows."""

    def create_device_mesh(shape: tuple[int, ...], devices: Sequence[Any], **_: Any) -> np.ndarray:
        devices = list(devices)
        if order == "interleaved":
            places = {device: n for process in range(jax.process_count()) for n, device in
                      enumerate(d for d in devices if d.process_index == process)}  # fmt: skip
            devices.sort(key=lambda device: (places[device], device.process_index))
        elif order == "scattered":
            devices = [devices[n] for n in np.random.default_rng(2).permutation(len(devices))]
        return np.array(devices).reshape(shape)

    with patch.object(mesh_utils, "create_device_mesh", create_device_mesh):
        yield


def run(case: Case, out: Path) -> None:
    """Train, and write what each update got."""
    seen: list[dict[str, np.ndarray]] = []
    to_devices = Run._to_devices

    def recorded(self: Run, batch: Any) -> Any:
        placed = to_devices(self, batch)
        kept = {name: array for name, array in placed.items() if name in ("record", "x")}
        seen.append(multihost_utils.process_allgather(kept, tiled=True))
        return placed

    settings: dict[str, Any] = {
        "steps": STEPS, "save_every": SAVE_EVERY, "keep": 5, "validate_every": STEPS,
        "mesh": case.config, "grad_accum_steps": case.parts,
    }  # fmt: skip
    task, samples, data = line.Line(), None, Path(case.data)
    if case.weights is not None:
        task, settings["sample_every"] = run_tiny.TASKS["egosim"], STEPS
        samples = Samples(model=run_tiny.MODEL, latents=data, vae=Path(case.weights), count=2)
    training = line.training(**settings)
    if case.weights is not None:  # Adam's first updates amplify gradients that are rounding errors
        training = replace(training, optimizer=OptimizerConfig(learning_rate=1e-5))
    with arranged(case.order), patch.object(Run, "_to_devices", recorded):
        networks = train(
            task,
            training,
            data=data,
            validation=data,
            out=out / case.name,
            samples=samples,
        )
        generated = {} if case.weights is None else generate(case)
    weights = [leaf.get_value() for _, leaf in nnx.to_flat_state(nnx.state(networks, nnx.Param))]
    weights = multihost_utils.process_allgather([w for w in weights if w.size], tiled=True)
    if jax.process_index() == 0:
        batches = {name: np.stack([batch[name] for batch in seen]) for name in seen[0]}
        flat = np.concatenate([np.ravel(weight) for weight in weights])
        np.savez(out / f"{case.name}.npz", weights=flat, **batches, **generated)


def generate(case: Case) -> dict[str, np.ndarray]:
    """Return the clips that a generator makes on the mesh of a case."""
    model, mesh = run_tiny.MODEL, make_mesh(case.config)
    triplets = [random_triplet(model.video, seed) for seed in range(2)]
    generator = Generator.load(model, case.weights, mesh=mesh)
    return {"clips": np.stack([clip.frames for clip in generator.generate(triplets, [5, 6])])}


def launch(out: Path, cases: Sequence[Case], *, processes: int, devices: int) -> None:
    """Run cases in new processes."""
    (out / "cases.json").write_text(json.dumps([asdict(case) for case in cases]))
    address, started = free_local_address(), []
    for index in range(processes):
        environment = os.environ | flags.devices(devices)
        environment |= {
            "JAX_COORDINATOR_ADDRESS": address,
            "JAX_NUM_PROCESSES": str(processes),
            "JAX_PROCESS_ID": str(index),
        }
        command = [sys.executable, "-m", "tests.training.run_rows", str(out)]
        with (out / f"{index}.log").open("w") as log:
            started.append(
                subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
            )
    try:
        codes = [process.wait(timeout=600) for process in started]
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert codes == [0] * processes, (out / f"{np.argmax(codes)}.log").read_text()[-3000:]


def main(folder: str) -> None:
    """Run the cases of a folder."""
    out = Path(folder)
    with distributed_context():
        for case in json.loads((out / "cases.json").read_text()):
            run(Case(**case), out)


if __name__ == "__main__":
    main(sys.argv[1])
