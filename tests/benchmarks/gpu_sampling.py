"""Seconds of denoising a clip with fewer or smaller forward passes (`bench_gpu sample`)."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from egosim_jax import configs
from egosim_jax.cli.preflight import compile_generation
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion import Guidance, Progressive, StepCache
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.denoising import denoise
from egosim_jax.generation.generator import Generator
from egosim_jax.preflight.report import Report
from egosim_jax.preflight.targets import GIB, find
from egosim_jax.sharding import make_mesh
from egosim_jax.types import MeshConfig
from tests.benchmarks.bench_passes import Counted
from tests.benchmarks.gpu import draw, draw_generator, taken, timed

THRESHOLD, SHARE, SCALE = 0.05, 0.5, 5.0


def sample(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Denoise a clip with guidance: with every pass, with a cache, and with half the grid at first.

    The number of passes that a cache skips depends on the weights, which are random here: read
    the seconds next to the passes that were made.
    """
    model = replace(configs.get(options.config), steps=options.steps or 6)
    full = replace(model, guidance=Guidance(scale=SCALE), cache=None, progressive=None)
    cached = StepCache(threshold=THRESHOLD)
    halved = Progressive(share=SHARE)
    variants = {
        "every pass": full,
        f"--cache {THRESHOLD:g}": replace(full, cache=cached),
        f"--progressive {SHARE:g}": replace(full, progressive=halved),
        "both": replace(full, cache=cached, progressive=halved),
    }
    if options.target is not None:
        for name, config in variants.items():
            yield {"sampling": name, **_predicted(config, options)}
        return
    line: dict[str, Any] = {}
    networks = draw_generator(full, line).networks
    yield line
    whole_s = None
    for name, config in variants.items():
        generator = Generator(config, networks)
        shapes = {key: given for key, _, given in generator.programs(options.clips)}["denoise"]
        rows: list[int] = []
        run = CompiledFn(
            lambda dit, c, n, rows=rows, config=config: denoise(Counted(dit, rows), c, n, config),
            networks.dit,
        )
        condition, noise = draw(shapes)
        line = {"sampling": name, "steps": config.steps, "clips": options.clips}
        timed(line, "compile_s", lambda r=run, given=shapes: r.compile(*given))
        latents = timed(line, "seconds", lambda r=run, c=condition, n=noise: r(c, n))
        jax.effects_barrier()
        whole_s = whole_s or line["seconds"]
        yield {
            **line,
            "share": line["seconds"] / whole_s,
            "passes": len(rows),
            "on half the grid": sum(count < latents.shape[2] for count in rows),
            "peak_gib": taken(),
            "finite": bool(jnp.isfinite(latents).all()),
        }


def _predicted(config: ModelConfig, options: argparse.Namespace) -> dict[str, Any]:
    """Return the memory and the roofline of denoising, if no pass is skipped."""
    target = find(options.target)
    mesh = make_mesh(MeshConfig(), target.devices)
    programs = compile_generation(config, target, mesh, options.clips)
    report = next(report for name, report in programs if name == "denoise")
    if not isinstance(report, Report):
        return {"needs_gib": report.needs / GIB, "fits": False}
    return {"preflight_gib": report.memory.peak / GIB, "roofline_s": report.roofline_s}
