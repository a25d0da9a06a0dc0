"""Preflight of every recipe on every target: the tables of docs/performance.md.

    pip install -e '.[cuda,tpu]'
    python -m tests.benchmarks.preflight [--only TEXT]
    python -m tests.benchmarks.preflight --write

A cell takes from 10 s to 2 minutes on two cores, half a minute more for 64 chips. Cells are stored
in tests/benchmarks/results/preflight.json: an interrupted run resumes, and a cell that is removed
there is compiled again; `--write` puts the stored cells into that page.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from egosim_jax import configs
from egosim_jax.cli.preflight import compile_generation
from egosim_jax.io.run import write_json, write_text
from egosim_jax.preflight.report import OutOfMemory, Report
from egosim_jax.preflight.targets import compile_offline, find
from egosim_jax.sharding import make_mesh, parts
from egosim_jax.train import recipes
from egosim_jax.train.preflight import compile_step
from egosim_jax.train.task import Stage
from egosim_jax.types import MeshConfig

BEGIN, END = "<!-- python -m tests.benchmarks.preflight --write -->", "<!-- end -->"
ROOT = Path(__file__).parents[2]
CELLS = Path(__file__).parent / "results" / "preflight.json"
REMATS = ("full", "attention", "projections", "products", "none", "offload")
SHARES = (("h200:8", (1, 2, 4)), ("h100:8", (1, 2, 4)), ("v5p:2x2x2", (1,)), ("v6e:8x8", (1,)))
"""Targets of a full fine-tuning of the 14B, and clips on a device at a time."""
TARGETS = ("h200:8", "h100:8", "h200:1", "h100:1", "b200:8", "v5p:2x2x2", "v6e:4x4", "v6e:8x8")
RECIPES = ("egosim_14b", "egosim_1_3b", "egosim_14b_robot", "egosim_14b_fewshot", "egosim_14b_lora")
DWM_TARGETS = ("h200:8", "h200:1", "h100:1")
DWM_RECIPES = ("dwm_cogvideox_5b", "dwm_wan_14b", "dwm_tabletop")


@dataclass(frozen=True, kw_only=True)
class Training:
    """A recipe's update; clips on a device at a time and remat are the recipe's unless given."""

    recipe: str
    target: str
    clips: int | None = None
    remat: str | None = None

    def measure(self) -> dict[str, Any]:
        recipe: Any = recipes.get(self.recipe)
        if self.remat is not None:
            recipe = replace(recipe, remat=self.remat)
        stages = [self._measure(stage) for stage in recipe.stages().values()]
        return max(stages, key=lambda cell: cell["peak"])

    def _measure(self, stage: Stage) -> dict[str, Any]:
        target = find(self.target)
        groups = parts("batch", make_mesh(stage.training.mesh, target.devices))
        batch = max(stage.training.batch_size, groups)  # one clip a device at least
        accumulate = stage.training.grad_accum_steps
        if self.clips is not None:
            accumulate = max(1, batch // groups // self.clips)
        elif batch % (groups * accumulate):
            accumulate = batch // groups
        training = replace(stage.training, batch_size=batch, grad_accum_steps=accumulate)
        report = compile_step(stage._replace(training=training), target)
        return {**_stored(report), "clips": batch // groups // accumulate, "batch": batch}


@dataclass(frozen=True, kw_only=True)
class Generation:
    """Generation: one clip for each device, or one that all devices share."""

    config: str
    target: str
    shared: bool

    def measure(self) -> dict[str, Any]:
        target, config = find(self.target), configs.get(self.config)
        layout = (
            MeshConfig(data=1, fsdp=1, context=-1) if self.shared else MeshConfig(data=-1, fsdp=1)
        )
        mesh = make_mesh(layout, target.devices)
        size = parts("batch", mesh)
        reports = dict(compile_generation(config, target, mesh, size))
        cells = [_stored(report) for report in reports.values()]
        worst = max(cells, key=lambda cell: cell["peak"])
        return {**worst, "roofline_s": sum(cell["roofline_s"] for cell in cells), "batch": size}


Cell = Training | Generation


def all_cells() -> Iterator[Cell]:
    for target, shares in SHARES:
        for clips in shares:
            for remat in REMATS:
                yield Training(recipe="egosim_14b", target=target, clips=clips, remat=remat)
    for shared, target in (
        (False, "h200:1"),
        (True, "h200:8"),
        (False, "h100:1"),
        (True, "h100:8"),
    ):
        yield Generation(config="egosim_14b", target=target, shared=shared)
    for targets, names in ((TARGETS, RECIPES), (DWM_TARGETS, DWM_RECIPES)):
        for target in targets:
            for recipe in names:
                yield Training(recipe=recipe, target=target)


def _stored(report: Report | OutOfMemory) -> dict[str, Any]:
    """Return what the tables show of a report."""
    known = isinstance(report, Report)
    return {
        "fits": report.fits,
        "peak": report.memory.peak if known else report.needs,
        "capacity": report.capacity,
        "roofline_s": report.roofline_s if known else math.nan,
    }


def _cell(values: dict[str, Any] | None) -> str:
    """Return the peak of a device in GiB, and its capacity if that is less."""
    if values is None:
        return ""
    need, have = (f"{x / 2**30:.0f}" for x in (values["peak"], values["capacity"]))
    return need if values["fits"] else f"{need} > {have}"


def _rows(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def tables(known: dict[str, dict[str, Any]]) -> str:
    """All cells as Markdown."""

    def found(cell: Cell) -> dict[str, Any] | None:
        return known.get(repr(cell))

    by_remat = [
        [f"`{target}`, {clips}"]
        + [
            _cell(found(Training(recipe="egosim_14b", target=target, clips=clips, remat=remat)))
            for remat in REMATS
        ]
        for target, shares in SHARES
        for clips in shares
    ]
    by_target = []
    for recipe in (*RECIPES, *DWM_RECIPES):
        cells = [found(Training(recipe=recipe, target=target)) for target in TARGETS]
        shown = [f"{_cell(c)} ({c['clips']})" if c else "" for c in cells]
        by_target.append([f"`{recipe}`", *shown])
    makes = [cell for cell in all_cells() if isinstance(cell, Generation) and found(cell)]
    generation = [
        [f"`{cell.target}`", "one, shared" if cell.shared else "one per device"]
        + [_cell(found(cell)), f"{known[repr(cell)]['roofline_s']:.0f} s"]
        for cell in makes
    ]
    return "\n\n".join(
        [
            "Peak memory of full fine-tuning of `egosim_14b`, in GiB per device, by `--remat` and\n"
            "by clips per device at a time. The batch is 32 (64 on 64 devices). A peak that does\n"
            "not fit is shown with the capacity:",
            _rows(["target, clips", *(f"`{remat}`" for remat in REMATS)], by_remat),
            "Peak memory of every recipe, in GiB per device (clips per device at a time). A batch\n"
            "that the devices cannot share in the recipe's parts uses fewer parts\n"
            "(`--training.grad-accum-steps`) or is raised to one clip per device:",
            _rows(["recipe", *(f"`{target}`" for target in TARGETS)], by_target),
            "Generation with `egosim_14b`, 50 steps, with the weights of all networks. The time\n"
            "is the roofline, a lower bound from the devices' peak:",
            _rows(["target", "clips", "GiB", "roofline"], generation),
        ]
    )


def write(known: dict[str, dict[str, Any]]) -> None:
    """Write the tables between the markers in docs/performance.md."""
    path = ROOT / "docs" / "performance.md"
    before, _, rest = path.read_text("utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    write_text(path, f"{before}{BEGIN}\n\n{tables(known)}\n\n{END}{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="measure cells whose name has this text")
    parser.add_argument("--write", action="store_true", help="only write the stored cells")
    options = parser.parse_args()
    compile_offline()
    known = json.loads(CELLS.read_text("utf-8")) if CELLS.exists() else {}
    if options.write:
        write(known)
        return
    todo = [cell for cell in all_cells() if repr(cell) not in known and options.only in repr(cell)]
    for number, cell in enumerate(todo, start=1):
        begun = time.monotonic()
        values = cell.measure()
        known[repr(cell)] = {**values, "seconds": time.monotonic() - begun}
        write_json(CELLS, known)
        verdict = "fits" if values["fits"] else "does not fit"
        print(
            f"{number}/{len(todo)} {cell}: {values['peak'] / 2**30:.1f} GiB, {verdict}, "
            f"{time.monotonic() - begun:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
