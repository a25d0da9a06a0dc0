"""Devices of machines that are not present, to arrange in meshes."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Device:
    """A device of a machine that is not present, as `jax.devices` describes it."""

    id: int
    process_index: int
    platform: str
    device_kind: str
    coords: tuple[int, ...] = ()
    core_on_chip: int = 0


def tpus(kind: str, *shape: int) -> list[Device]:
    """A slice whose hosts have 2 x 2 chips: ids by coordinates, devices in the order of hosts."""
    sizes = (*shape, 1)[:3]
    devices = []
    for number, place in enumerate(np.ndindex(*sizes[::-1])):
        x, y, z = place[::-1]
        host = x // 2 + sizes[0] // 2 * (y // 2 + sizes[1] // 2 * z)
        devices.append(Device(number, host, "tpu", kind, (x, y, z)))
    return sorted(devices, key=lambda device: device.process_index)


def gpus(kind: str, count: int) -> list[Device]:
    """Machines of eight GPUs."""
    return [Device(number, number // 8, "gpu", kind) for number in range(count)]


MACHINES = {
    "v5e:4x4": tpus("TPU v5 lite", 4, 4),
    "v6e:4x4": tpus("TPU v6 lite", 4, 4),
    "v5e:8x8": tpus("TPU v5 lite", 8, 8),
    "v5p:4x4x4": tpus("TPU v5", 4, 4, 4),
    "h200:16": gpus("NVIDIA H200", 16),
    "b200:72": gpus("NVIDIA B200", 72),
}
"""Targets of the preflight. `tests/unit/preflight` compares them with the compilers' own."""
