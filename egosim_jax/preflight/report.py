"""Report of a compiled program on its target: memory, FLOPs and roofline time."""

from __future__ import annotations

import math
import re
import time
from dataclasses import asdict, dataclass
from typing import Any

import jax

from egosim_jax.preflight import flops
from egosim_jax.preflight.targets import GIB, Target

_NEEDS = (
    re.compile(r"Used ([\d.]+)([GMK]) of ([\d.]+)([GMK]) hbm"),
    re.compile(r"\(([\d.]+)([GMK])\) exceeds available HBM \(([\d.]+)([GMK])\)"),
)
"""Out-of-memory messages of the TPU compiler, with the bytes needed and available."""


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Memory of a program in bytes per device."""

    arguments: int
    """Arguments: weights, moments, batch."""
    results: int
    """Results that are not donated arguments."""
    temporaries: int
    """Temporary buffers: activations, gradients, gathered weights."""

    @property
    def peak(self) -> int:
        """Return the peak: arguments, results and temporaries."""
        return self.arguments + self.results + self.temporaries


@dataclass(frozen=True, kw_only=True)
class Report:
    """Costs of a program that was compiled for a target."""

    target: str
    """Name of the target."""
    devices: int
    """Number of devices of the target."""
    capacity: float
    """Bytes of a device that a program may use."""
    memory: Memory
    """Memory that the program uses."""
    model_flops: float
    """FLOPs that the model requires, on all devices; NaN if not counted."""
    hardware_flops: float
    """FLOPs that the program executes, on all devices, including rematerialization."""
    roofline_s: float
    """Seconds for the FLOPs at the devices' peak, a lower bound; NaN if the peak is unknown."""
    compile_s: float
    """Compilation time in seconds."""

    @property
    def fits(self) -> bool:
        """Return whether the peak fits the device's memory."""
        return self.memory.peak <= self.capacity


@dataclass(frozen=True, kw_only=True)
class OutOfMemory:
    """A program that the target's compiler refused because it needs more memory."""

    target: str
    """Name of the target."""
    needs: float
    """Bytes of a device that it needs."""
    capacity: float
    """Bytes of a device that a program may use."""

    @property
    def fits(self) -> bool:
        """Return False: it does not fit."""
        return False


def compile_for(
    target: Target,
    traced: Any,
    *,
    model_flops: float = math.nan,
    resident: int = 0,
    taken: float = 1.0,
) -> Report | OutOfMemory:
    """Compile a trace of `jax.jit` for the target's devices, and report its costs.

    `resident` is the size in bytes of other data on the device, such as all networks' weights, and
    `taken` the share of the steps at which a condition runs its costliest branch (`flops.count`).
    """
    begun = time.perf_counter()
    try:
        stats = traced.lower().compile().memory_analysis()
    except jax.errors.JaxRuntimeError as error:
        return parse_oom(error, target)
    compile_s = time.perf_counter() - begun
    device, count = target.device, len(target.devices)
    results = stats.output_size_in_bytes - stats.alias_size_in_bytes
    temporaries = stats.temp_size_in_bytes
    if device.platform == "tpu":  # its temporaries include donated arguments
        temporaries = stats.peak_memory_in_bytes - stats.argument_size_in_bytes - results
    hardware_flops = flops.count(traced.jaxpr, taken=taken)
    return Report(
        target=target.name,
        devices=count,
        capacity=target.capacity,
        memory=Memory(
            arguments=max(resident, stats.argument_size_in_bytes),
            results=results,
            temporaries=temporaries,
        ),
        model_flops=model_flops,
        hardware_flops=hardware_flops,
        roofline_s=hardware_flops / count / device.flops,
        compile_s=compile_s,
    )


def parse_oom(error: Exception, target: Target) -> OutOfMemory:
    """Parse a compiler's out-of-memory error; raise any other error again."""
    found = next(filter(None, (needs.search(str(error)) for needs in _NEEDS)), None)
    if found is None:
        raise error
    units = {"K": 2**10, "M": 2**20, "G": GIB}
    used, unit, have, its = found.groups()
    return OutOfMemory(
        target=target.name, needs=float(used) * units[unit], capacity=float(have) * units[its]
    )


def text(report: Report | OutOfMemory) -> str:
    """Format a report for a terminal."""
    if isinstance(report, OutOfMemory):
        return (
            f"  {'peak':<16}{size(report.needs)} of {size(report.capacity)}: does not fit, reports "
            "the target's compiler"
        )
    memory = report.memory
    rows = [
        ("arguments", memory.arguments, "weights, moments, batch"),
        ("results", memory.results, "besides donated arguments"),
        ("temporaries", memory.temporaries, "activations, gradients, gathered weights"),
    ]
    verdict = "fits" if report.fits else "does not fit"
    lines = ["  memory of a device"]
    lines += [f"    {name:<14}{size(bytes_)}   {what}" for name, bytes_, what in rows]
    lines += [f"    {'peak':<14}{size(memory.peak)}   of {size(report.capacity)}: {verdict}"]
    lines += ["", f"  {'work':<16}{_work(report)}"]
    if not math.isnan(report.roofline_s):
        lines.append(f"  {'roofline s':<16}{report.roofline_s:.4g}")
    return "\n".join([*lines, f"  {'compiled in':<16}{report.compile_s:.1f} s"])


def size(bytes_: int | float) -> str:
    """Format bytes with a unit, ten characters wide."""
    unit, name = (GIB, "GiB") if bytes_ >= GIB else (2**20, "MiB")
    return f"{bytes_ / unit:6.1f} {name}"


def _work(report: Report) -> str:
    """Format the FLOPs executed, and those that the model requires."""
    done, needed = _flops(report.hardware_flops), report.model_flops
    most = "" if math.isnan(needed) else f", {_flops(needed)} required by the model"
    return f"{done} executed{most}"


def _flops(count: float) -> str:
    unit, name = next(
        (unit, name)
        for unit, name in ((1e15, "PFLOP"), (1e12, "TFLOP"), (1e9, "GFLOP"), (1, "FLOP"))
        if count >= unit
    )
    return f"{count / unit:.4g} {name}"


def plain(report: Report | OutOfMemory) -> dict[str, Any]:
    """Return a report with its derived numbers as JSON values."""
    values = {**asdict(report), "fits": report.fits}
    if isinstance(report, Report):
        values["peak"] = report.memory.peak
    return values
