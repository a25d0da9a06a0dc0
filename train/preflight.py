"""Preflight of a training: compile its update for a target machine, and report whether it fits.

Training runs the same update: the same function, mesh, shardings and donation. After the recipe's
own setting, the search compiles other settings of the same batch size: all numbers of clips on a
device at a time and all rematerializations that fit its memory. If none fits, 2 devices share a
clip, then 4, and so on.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax

from egosim_jax.preflight.report import OutOfMemory, Report, compile_for, plain, size, text
from egosim_jax.preflight.targets import Target, find
from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.progress import track
from egosim_jax.sharding import (
    batch_sharding,
    check_batch,
    make_mesh,
    parts,
    process_rows,
    row_groups,
)
from egosim_jax.train.task import Stage
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.update import Programs
from egosim_jax.types import MeshConfig

ANNOUNCEMENT = "looking for other settings that fit, which takes minutes; --no-search skips it"
NO_REMAT = "none"
"""Rematerialization of a network whose config has none."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """The number of clips that are computed at a time, and the rematerialization."""

    clips: int
    """Clips on a device at a time; devices that share a clip count as one."""
    remat: str
    """Rematerialization in the backward pass."""
    context: int = 1
    """Number of devices that share a clip."""


@dataclass(frozen=True, kw_only=True)
class Host:
    """A host of a target, which runs one process of a training."""

    host: int
    """Index of the host."""
    devices: int
    """Number of its devices."""
    rows: tuple[int, ...]
    """Rows of each batch that its devices hold, which its process reads."""


def preflight(stages: Mapping[str, Stage], name: str, *, as_json: bool, search: bool) -> int:
    """Print the report of each stage of a recipe on a target; return 1 if one does not fit."""
    target, fit = find(name), True
    found: dict[str, dict[str, Any]] = {}
    for title, stage in stages.items():
        hosts = hosts_of(stage, target)
        if not as_json:
            print(f"{_heading(title, stage, target)}\n\n{_rows(hosts)}\n", flush=True)
        report = compile_step(stage, target)
        fit &= report.fits
        found[title] = {"hosts": [asdict(host) for host in hosts], "asked": plain(report)}
        if not as_json:
            print(f"{text(report)}\n{_host_memory(hosts, report)}", flush=True)
        # Settings are ordered by predicted speed, so a search needs the device's peak.
        known_speed = not math.isnan(target.device.flops)
        if search and isinstance(stage.task, Denoising) and known_speed:
            print(ANNOUNCEMENT, file=sys.stderr, flush=True)
            others = _others(stage, target, report)
            found[title]["settings"] = [
                {**asdict(setting), **plain(report)} for setting, report in others.items()
            ]
            if not as_json:
                print(_table(others, stage.training.batch_size))
    if as_json:
        print(json.dumps(found, indent=2))
    return ExitCode.DONE if fit else ExitCode.FAILED


def hosts_of(stage: Stage, target: Target) -> list[Host]:
    """Return the hosts of a target. Raises `InputError` if the target does not fit the mesh."""
    training = stage.training
    mesh = make_mesh(training.mesh, target.devices)
    check_batch(training.batch_size, mesh, training.grad_accum_steps, stage="training")
    devices = Counter(device.process_index for device in target.devices)
    rows = process_rows(batch_sharding(mesh), training.batch_size)
    return [Host(host=host, devices=devices[host], rows=rows[host]) for host in rows]


def compile_step(stage: Stage, target: Target) -> Report | OutOfMemory:
    """Compile an update for a target. Raises `InputError` if the target does not fit the mesh."""
    task, training = stage
    mesh = make_mesh(training.mesh, target.devices)
    programs, placed = Programs.of(task, training, mesh), batch_sharding(mesh)
    batch = {
        name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=placed)
        for name, leaf in task.shapes(training.batch_size).items()
    }
    with jax.set_mesh(mesh):
        traced = programs.update.trace(programs.state, programs.frozen, batch)
        return compile_for(target, traced, model_flops=task.flops(training.batch_size))


def _others(stage: Stage, target: Target, asked: Report | OutOfMemory) -> dict[Setting, Report]:
    """Return the settings that fit, fastest first, with as few devices per clip as possible."""
    known = {_setting(stage, target): asked}
    for mesh in _meshes(stage, target):
        shared = stage._replace(training=replace(stage.training, mesh=mesh))
        fitting = _fitting(shared, target, known)
        if fitting:
            # By the seconds at the devices' peak, then by peak memory.
            reports = fitting.items()
            return dict(sorted(reports, key=lambda item: (item[1].roofline_s, item[1].memory.peak)))
    return {}


def _meshes(stage: Stage, target: Target) -> Iterator[MeshConfig]:
    """Yield the given mesh, then meshes with 2, 4, ... times as many devices per clip."""
    task: Any = stage.task
    own = make_mesh(stage.training.mesh, target.devices).shape
    context = own["context"]
    while own["fsdp"] % (context // own["context"]) == 0 and task.model.dit.heads % context == 0:
        yield MeshConfig(data=own["data"], fsdp=-1, context=context)
        context *= 2


def _fitting(
    stage: Stage, target: Target, known: Mapping[Setting, Report | OutOfMemory]
) -> dict[Setting, Report]:
    """Return the settings that fit on a mesh."""
    mesh = make_mesh(stage.training.mesh, target.devices)
    share, context = stage.training.batch_size // parts("batch", mesh), parts("tokens", mesh)
    counts = [clips for clips in range(1, share + 1) if share % clips == 0]
    fitting: dict[Setting, Report] = {}
    task: Any = stage.task
    levels = task.model.dit.remat_levels or (NO_REMAT,)

    def tries() -> Iterator[None]:
        nonlocal levels
        for clips in counts:
            for index, remat in enumerate(levels):
                setting = Setting(clips=clips, remat=remat, context=context)
                report = known.get(setting)
                if report is None:
                    report = compile_step(_with(stage, setting, share), target)
                yield
                if not isinstance(report, Report) or not report.fits:
                    # Levels that keep more do not fit either, nor with more clips.
                    levels = levels[:index]
                    break
                fitting[setting] = report

    shared = f", {context} devices per clip" if context > 1 else ""
    for _ in track(tries(), f"compiling other settings{shared}", total=len(counts) * len(levels)):
        pass
    return fitting


def _heading(title: str, stage: Stage, target: Target) -> str:
    setting, device = _setting(stage, target), target.devices[0].device_kind
    shared = f", {setting.context} per clip" if setting.context > 1 else ""
    return (
        f"{title} on {target.name}, {len(target.devices)} x {device}{shared}: batch "
        f"{stage.training.batch_size}, {setting.clips} on a device at a time, remat {setting.remat}"
    )


def _rows(hosts: Sequence[Host]) -> str:
    """Format the rows of each host; a line for all hosts with the same rows."""
    groups = row_groups({host.host: host.rows for host in hosts})
    named = {_ranges(group): _ranges(rows) for rows, group in groups.items()}
    width = max(map(len, named)) + 2
    lines = [f"    {group:<{width}}{rows}" for group, rows in named.items()]
    each = ", ".join(sorted({str(host.devices) for host in hosts}))
    return "\n".join([f"  rows of the batch by host, {each} devices each", *lines])


def _host_memory(hosts: Sequence[Host], report: Report | OutOfMemory) -> str:
    """Format the memory that the devices of each host need together; all hosts have as many."""
    peak = report.memory.peak if isinstance(report, Report) else report.needs
    each = hosts[0].devices
    return f"  {'a host':<16}{each} devices, {size(each * peak)} of {size(each * report.capacity)}"


def _ranges(numbers: Sequence[int]) -> str:
    """Format ascending numbers: `0, 1, 6 to 9`."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][-1] + 1:
            spans[-1].append(number)
        else:
            spans.append([number])
    return ", ".join(
        f"{span[0]} to {span[-1]}" if len(span) > 2 else ", ".join(map(str, span)) for span in spans
    )


def _setting(stage: Stage, target: Target) -> Setting:
    task, training = stage
    mesh = make_mesh(training.mesh, target.devices)
    dit: Any = task.model.dit if isinstance(task, Denoising) else None
    remat = dit.remat if dit and dit.remat_levels else NO_REMAT
    clips = training.batch_size // parts("batch", mesh) // training.grad_accum_steps
    return Setting(clips=clips, remat=remat, context=parts("tokens", mesh))


def _with(stage: Stage, setting: Setting, share: int) -> Stage:
    task: Any = stage.task
    dit = task.model.dit
    if dit.remat_levels:
        dit = replace(dit, remat=setting.remat)
    return Stage(
        replace(task, model=replace(task.model, dit=dit)),
        replace(stage.training, grad_accum_steps=share // setting.clips),
    )


def _table(settings: Mapping[Setting, Report], batch: int) -> str:
    if not settings:
        return "  no setting of this batch fits: more devices"
    columns = f"{'clips at a time':<17}{'grad accum':<12}{'context':<9}{'remat':<13}"
    lines = ["", "  settings that fit, best first"]
    lines.append(f"    {columns}{'peak':>10}{'roofline s':>11}{'clips/s':>9}")
    for setting, report in settings.items():
        least = report.roofline_s
        accumulate = batch * setting.context // report.devices // setting.clips
        lines.append(
            f"    {setting.clips:<17}{accumulate:<12}{setting.context:<9}{setting.remat:<13}"
            f"{size(report.memory.peak):>10}{least:11.3g}{batch / least:9.3g}"
        )
    return "\n".join(lines)
