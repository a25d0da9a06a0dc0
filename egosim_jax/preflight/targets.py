"""Target machines to compile for; the machine need not be present.

XLA's compilers for NVIDIA GPUs and for TPUs come with jax's packages and run anywhere. They take a
TPU slice by its name, and a GPU by the properties that its driver would report.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal

from egosim_jax.types import InputError

Platform = Literal["cpu", "gpu", "tpu"]


@dataclass(frozen=True, kw_only=True)
class Chip:
    """CUDA device properties that XLA's GPU compiler needs."""

    capability: tuple[int, int]
    """CUDA compute capability, major and minor."""
    cores: int
    """Number of streaming multiprocessors."""
    shared: int
    """Bytes of shared memory per multiprocessor; a block may use 1024 less."""
    l2: int
    """Bytes of L2 cache."""
    clock_ghz: float
    """Boost clock in GHz."""


@dataclass(frozen=True, kw_only=True)
class Device:
    """Data sheet of a device; NaN where a number is unknown."""

    kind: str
    """Beginning of jax's `device_kind`."""
    platform: Platform
    """jax's name of the platform."""
    flops: float
    """Peak of a device in dense bfloat16 FLOP/s."""
    memory: float
    """Bytes of device memory."""
    bandwidth: float
    """Memory bandwidth in bytes/s."""
    chip: Chip | None = None
    """Compiler properties, if it is a GPU."""


GIB = 2**30
UNKNOWN = float("nan")
HOPPER = Chip(capability=(9, 0), cores=132, shared=233472, l2=52428800, clock_ghz=1.98)

DEVICES: Mapping[str, Device] = {
    # NVIDIA's data sheets of A100 80GB SXM, H100 SXM, H200 SXM and HGX B200.
    "a100": Device(
        kind="NVIDIA A100",
        platform="gpu",
        flops=312e12,
        memory=85.0e9,
        bandwidth=2.039e12,
        chip=Chip(capability=(8, 0), cores=108, shared=167936, l2=41943040, clock_ghz=1.41),
    ),
    "h100": Device(
        kind="NVIDIA H100",
        platform="gpu",
        flops=989.4e12,
        memory=84.9e9,
        bandwidth=3.35e12,
        chip=HOPPER,
    ),
    "h200": Device(
        kind="NVIDIA H200",
        platform="gpu",
        flops=989.4e12,
        memory=150.7e9,
        bandwidth=4.8e12,
        chip=HOPPER,
    ),
    "b200": Device(
        kind="NVIDIA B200",
        platform="gpu",
        flops=2250e12,
        memory=191.5e9,
        bandwidth=8e12,
        chip=Chip(capability=(10, 0), cores=148, shared=233472, l2=132644864, clock_ghz=1.965),
    ),
    # Google's pages on each TPU version; memory as the compiler reports it.
    "v5e": Device(
        kind="TPU v5 lite", platform="tpu", flops=197e12, memory=15.75 * GIB, bandwidth=0.8e12
    ),
    "v5p": Device(
        kind="TPU v5", platform="tpu", flops=459e12, memory=95.74 * GIB, bandwidth=2.765e12
    ),
    "v6e": Device(
        kind="TPU v6 lite", platform="tpu", flops=918e12, memory=31.25 * GIB, bandwidth=1.6e12
    ),
}
"""Devices by the name in a target."""
OFFLINE_ENV = {
    "JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1",
    "TPU_SKIP_MDS_QUERY": "1",
    "TPU_ACCELERATOR_TYPE": "v5p-8",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "ALLOW_MULTIPLE_LIBTPU_LOAD": "1",
}
"""Environment variables that stop the compilers from looking for a driver, TPU host or lock."""
GPU_HOST = 8
"""Maximum number of GPUs of a host: hosts of more GPUs have equal numbers, such as 9 x 8."""
GPU_SHARE = 0.95
"""Share of a GPU's memory that XLA may allocate, with the settings of docs/train.md."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """Machine to compile for."""

    name: str
    """Name, such as h200:8."""
    device: Device
    """Data sheet of its devices."""
    devices: Sequence[Any]
    """jax devices, for compilation only."""

    @property
    def capacity(self) -> float:
        """Return the bytes of a device that a program may use."""
        return self.device.memory * (GPU_SHARE if self.device.platform == "gpu" else 1)


def parse(name: str) -> tuple[str, str]:
    """Split a target into device and size. Raises `InputError` if it is not a target."""
    kind, colon, size = name.partition(":")
    known = [*DEVICES, "cpu"]
    if kind not in known:
        near = difflib.get_close_matches(kind, known, n=1, cutoff=0.0)[0]
        raise InputError(
            f"Unknown target {name!r}. Nearest device: {near}. Devices: {', '.join(known)}."
        )
    tpu = kind != "cpu" and DEVICES[kind].platform == "tpu"
    if not re.fullmatch(r"[1-9]\d*(x[1-9]\d*)+" if tpu else r"[1-9]\d*", size) or not colon:
        example = f"{kind}:2x2x2 or {kind}:4x4, a slice" if tpu else f"{kind}:8, a number"
        raise InputError(f"Target {name!r} needs a size of the form {example} of devices.")
    return kind, size


def compile_offline() -> None:
    """Set up this process to compile for absent devices; an entry point calls it before jax starts.

    Sets the variables of `OFFLINE_ENV`, and limits jax to the CPU.
    """
    import jax

    for variable, value in OFFLINE_ENV.items():
        os.environ.setdefault(variable, value)
    jax.config.update("jax_platforms", "cpu")


def find(name: str) -> Target:
    """Return a target by name: `h200:8`, `v5p:2x2x2`, `cpu:1`.

    GPUs and TPUs need `compile_offline`. Raises `InputError` if the target is unknown, or its
    compiler is not installed.
    """
    kind, size = parse(name)
    if kind == "cpu":
        return Target(name=name, device=_this_processor(), devices=_processors(int(size)))
    device = DEVICES[kind]
    if device.chip is not None:
        return Target(name=name, device=device, devices=_gpus(device, device.chip, int(size)))
    return Target(name=name, device=device, devices=_slice(name))


def peak(kind: str) -> float:
    """Return the dense bfloat16 FLOP/s of jax's `device_kind`; NaN if unknown."""
    known = [device for device in DEVICES.values() if kind.startswith(device.kind)]
    return max(known, key=lambda device: len(device.kind)).flops if known else UNKNOWN


def _this_processor() -> Device:
    import jax

    kind = jax.devices("cpu")[0].device_kind
    memory = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return Device(kind=kind, platform="cpu", flops=UNKNOWN, memory=memory, bandwidth=UNKNOWN)


def _processors(count: int) -> Sequence[Any]:
    import jax

    devices = jax.devices("cpu")
    if count > len(devices):
        raise InputError(
            f"{count} CPU devices were requested, {len(devices)} are available: set "
            f"XLA_FLAGS=--xla_force_host_platform_device_count={count}."
        )
    return devices[:count]


def _gpus(device: Device, chip: Chip, count: int) -> Sequence[Any]:
    from jax.experimental import topologies

    if not any(find_spec(f"jax_cuda{version}_plugin") for version in (12, 13)):
        raise InputError(
            "The compiler for NVIDIA GPUs is not installed; it needs no GPU: "
            "pip install 'egosim-jax[cuda]'"
        )
    each = count if count <= GPU_HOST else math.gcd(count, GPU_HOST)
    return topologies.get_topology_desc(
        platform="cuda",
        topology_name=device.kind,
        target_config=_properties(device, chip),
        topology=f"1x{count // each}x{each}",
    ).devices


def _properties(device: Device, chip: Chip) -> str:
    """Return a stream_executor.GpuTargetConfigProto in text format."""
    major, minor = chip.capability
    extension = " feature_extension: ACCELERATED_FEATURES" if major >= 9 else ""
    return f"""
        gpu_device_info {{
          threads_per_block_limit: 1024
          threads_per_warp: 32
          threads_per_core_limit: 2048
          shared_memory_per_block: 49152
          shared_memory_per_core: {chip.shared}
          shared_memory_per_block_optin: {chip.shared - 1024}
          registers_per_core_limit: 65536
          registers_per_block_limit: 65536
          core_count: {chip.cores}
          fpus_per_core: 128
          block_dim_limit_x: 2147483647
          block_dim_limit_y: 65535
          block_dim_limit_z: 65535
          memory_bandwidth: {int(device.bandwidth)}
          device_memory_size: {int(device.memory)}
          l2_cache_size: {chip.l2}
          clock_rate_ghz: {chip.clock_ghz}
          cuda_compute_capability {{ major: {major} minor: {minor}{extension} }}
          device_vendor: "NVIDIA Corporation"
          device_address_bits: 64
          name: "{device.kind}"
          driver_version: "13.0.0"
          runtime_version: "12.8.0"
          compile_time_toolkit_version: "12.8.0"
          dnn_version: "9.10.0"
        }}
        platform_name: "CUDA"
        dnn_version_info {{ major: 9 minor: 10 patch: 0 }}
        device_description_str: "{device.kind}"
    """


def _slice(name: str) -> Sequence[Any]:
    from jax.experimental import topologies

    if find_spec("libtpu") is None:
        raise InputError(
            "The compiler for TPUs is not installed; it needs no TPU: pip install 'egosim-jax[tpu]'"
        )
    try:
        return topologies.get_topology_desc(name, platform="tpu").devices
    except Exception as error:  # jaxlib's, which names the valid shapes
        raise InputError(f"Unknown TPU slice {name}: {error}") from error
