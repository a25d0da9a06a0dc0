"""A compiled program beside the machine it is for: memory, collectives, and the least time."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax

from egosim_jax.preflight import flops
from egosim_jax.preflight.hlo import Big, Moved, Program
from egosim_jax.preflight.targets import GIB, Target

LARGEST = 10
_NEEDS = (
    re.compile(r"Used ([\d.]+)([GMK]) of ([\d.]+)([GMK]) hbm"),
    re.compile(r"\(([\d.]+)([GMK])\) exceeds available HBM \(([\d.]+)([GMK])\)"),
)
"""How a TPU's compiler says what a program would take, and what there is."""


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Bytes on a device."""

    arguments: int
    """What is given: weights, moments, batch."""
    results: int
    """What is given back and does not take the place of an argument."""
    temporaries: int
    """What lies there meanwhile."""

    @property
    def peak(self) -> int:
        """All of it."""
        return self.arguments + self.results + self.temporaries


@dataclass(frozen=True, kw_only=True)
class Report:
    """What is known of a program that was compiled for a target."""

    target: str
    """The target's name."""
    devices: int
    """Of the target."""
    capacity: float
    """Bytes of a device that a program may use."""
    memory: Memory
    """What it takes of them."""
    largest: Sequence[Big]
    """The largest arrays on a device."""
    collectives: Mapping[str, Moved]
    """By kind, what a device sends."""
    model_flops: float
    """What the model takes, on all devices; NaN if nobody counted."""
    hardware_flops: float
    """What the program does, on all devices: with all that it computes twice."""
    compute_s: float
    """Least seconds for the FLOPs, at the devices' peak."""
    memory_s: float
    """Least seconds for what is read and written, if every operation does so once."""
    link_s: float
    """Least seconds for the collectives."""
    compile_s: float
    """Seconds that it took to compile."""

    @property
    def fits(self) -> bool:
        """Whether a device has the memory."""
        return self.memory.peak <= self.capacity

    @property
    def most_mfu(self) -> float:
        """Model FLOPs utilization if a step took `least_s`."""
        return self.model_flops / self.hardware_flops * self.compute_s / self.least_s

    @property
    def least_s(self) -> float:
        """The longest of the three: what is left if the others hide behind it."""
        return max(self.compute_s, self.memory_s, self.link_s)


@dataclass(frozen=True, kw_only=True)
class TooLarge:
    """A program that the target's compiler refused for want of memory."""

    target: str
    """The target's name."""
    needs: float
    """Bytes of a device that it would take."""
    capacity: float
    """Bytes that there are."""

    @property
    def fits(self) -> bool:
        """It does not."""
        return False


def compile_for(
    target: Target, traced: Any, *, model_flops: float = math.nan, resident: int = 0
) -> Report | TooLarge:
    """Compile what `jax.jit` traced, on the target's devices, and read off it what it takes."""
    begun = time.perf_counter()
    try:
        compiled = traced.lower().compile()
    except jax.errors.JaxRuntimeError as error:
        return refusal(error, target)
    return inspect(
        compiled,
        target,
        model_flops=model_flops,
        hardware_flops=flops.count(traced.jaxpr),
        compile_s=time.perf_counter() - begun,
        resident=resident,
    )


def inspect(
    compiled: Any,
    target: Target,
    *,
    model_flops: float,
    hardware_flops: float,
    compile_s: float,
    resident: int,
) -> Report:
    """Read everything off a program that was compiled for a target.

    `resident` is what lies on a device anyway, in bytes, with or without the program's own weights.
    """
    program, stats = Program.read(compiled.as_text()), compiled.memory_analysis()
    device, count = target.device, len(target.devices)
    collectives = program.collectives()
    results = stats.output_size_in_bytes - stats.alias_size_in_bytes
    temporaries = stats.temp_size_in_bytes
    if device.platform == "tpu":  # which counts arguments that are overwritten here, too
        temporaries = stats.peak_memory_in_bytes - stats.argument_size_in_bytes - results
    return Report(
        target=target.name,
        devices=count,
        capacity=target.capacity,
        memory=Memory(
            arguments=max(resident, stats.argument_size_in_bytes),
            results=results,
            temporaries=temporaries,
        ),
        largest=program.largest(LARGEST),
        collectives=collectives,
        model_flops=model_flops,
        hardware_flops=hardware_flops,
        compute_s=hardware_flops / count / device.flops,
        memory_s=program.traffic() / device.bandwidth,
        link_s=sum(moved.bytes for moved in collectives.values()) / device.link,
        compile_s=compile_s,
    )


def refusal(error: Exception, target: Target) -> TooLarge:
    """What a compiler said that ran out of memory. Raises any other error again."""
    found = next(filter(None, (needs.search(str(error)) for needs in _NEEDS)), None)
    if found is None:
        raise error
    units = {"K": 2**10, "M": 2**20, "G": GIB}
    used, unit, have, its = found.groups()
    return TooLarge(
        target=target.name, needs=float(used) * units[unit], capacity=float(have) * units[its]
    )


def text(report: Report | TooLarge) -> str:
    """A report as it is read on a screen."""
    if isinstance(report, TooLarge):
        return (
            f"  {'peak':<16}{size(report.needs)} of {size(report.capacity)}: does not fit, says "
            "the target's compiler"
        )
    memory = report.memory
    rows = [
        ("arguments", memory.arguments, "weights, moments, what is read"),
        ("results", memory.results, "beside what is updated in place"),
        ("temporaries", memory.temporaries, "activations, gradients, what was gathered"),
    ]
    verdict = "fits" if report.fits else "does not fit"
    lines = ["  memory of a device"]
    lines += [f"    {name:<14}{size(bytes_)}   {what}" for name, bytes_, what in rows]
    lines += [f"    {'peak':<14}{size(memory.peak)}   of {size(report.capacity)}: {verdict}"]
    lines += ["", "  largest arrays"]
    lines += [f"    {_big(big)}" for big in report.largest]
    if report.collectives:
        lines += ["", "  collectives of a device: how many, and what it sends"]
        lines += [
            f"    {kind:<20}{moved.count:8d}   {size(moved.bytes)}"
            for kind, moved in report.collectives.items()
        ]
    lines += ["", f"  {'work':<16}{_work(report)}"]
    if not math.isnan(report.least_s):
        lines.append(
            f"  {'least seconds':<16}compute {report.compute_s:.4g}, memory {report.memory_s:.4g}, "
            f"interconnect {report.link_s:.4g}"
        )
    return "\n".join([*lines, f"  {'compiled in':<16}{report.compile_s:.1f} s"])


def size(bytes_: int | float) -> str:
    """Bytes with a unit, ten letters wide."""
    unit, name = (GIB, "GiB") if bytes_ >= GIB else (2**20, "MiB")
    return f"{bytes_ / unit:6.1f} {name}"


def _work(report: Report) -> str:
    """What is done, and how much of it the model asks for."""
    done = _flops(report.hardware_flops)
    if math.isnan(report.model_flops):
        return done
    most = f", utilization {report.most_mfu:.1%} at most" if not math.isnan(report.least_s) else ""
    return f"{done} are done, {_flops(report.model_flops)} are the model's{most}"


def _flops(count: float) -> str:
    unit, name = next(
        (unit, name)
        for unit, name in ((1e15, "PFLOP"), (1e12, "TFLOP"), (1e9, "GFLOP"), (1, "FLOP"))
        if count >= unit
    )
    return f"{count / unit:.4g} {name}"


def _big(big: Big) -> str:
    where = "/".join(big.source.replace("\\'", "'").split("/")[-3:])
    times = f" x {big.count}" if big.count > 1 else ""
    return f"{size(big.bytes)}  {big.shape}{times}  {where}".rstrip()


def plain(report: Report | TooLarge) -> dict[str, Any]:
    """A report, with what follows from it, as JSON values."""
    values = {**asdict(report), "fits": report.fits}
    if isinstance(report, Report):
        values |= {"peak": report.memory.peak, "least_s": report.least_s}
    return values
