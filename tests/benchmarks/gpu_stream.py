"""Seconds of the chunks of a causal student, measured or predicted (`bench_gpu stream`)."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from egosim_jax import configs
from egosim_jax.cli.preflight import compile_generation
from egosim_jax.configs.model import ModelConfig
from egosim_jax.generation.encoding import last_32_bits, pack_clip, pack_videos
from egosim_jax.generation.generator import Generator
from egosim_jax.generation.stream import ClipStream, split_triplet
from egosim_jax.interactive.server import wire
from egosim_jax.models.chunks import Chunks
from egosim_jax.preflight.report import Report
from egosim_jax.preflight.targets import GIB, find
from egosim_jax.sharding import make_mesh
from egosim_jax.testing import random_triplet
from egosim_jax.types import MeshConfig
from tests.benchmarks.gpu import compile_all, draw_generator, speed, taken, timed

MFU = 0.64
"""Share of the peak at which one H200 denoised (docs/gpu.md)."""
HOST_BYTES_S = 25e9
"""Bytes per second from a device to the host, of PCIe 5.0 x16 at half of its rate."""


def stream(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The chunks of a causal student, as a client sees them.

    `first_frame_s` and `last_frame_s` are from the action of a chunk to its frames in the host's
    memory, each chunk given after the one before was seen. The parts of a chunk are measured again,
    one after the other; what the sum of the parts exceeds `last_frame_s` by was overlapped. At last
    a clip is streamed whose chunks are all given at once (`ahead`).
    """
    chunks = Chunks(sizes=tuple(options.chunks), first_steps=options.first_steps)
    config = replace(configs.get(options.config), steps=options.steps or 2, chunks=chunks)
    if options.target is not None:
        yield from _predicted_stream(config, options)
        return
    line: dict[str, Any] = {"config": config.name, "chunks": str(chunks), "steps": config.steps}
    generator = draw_generator(config, line)
    list(compile_all(generator, 1, line, streamed=True))
    yield line
    clip = random_triplet(config.video, 0)
    given = split_triplet(clip, config.chunk_frames)
    for attempt in range(options.repeats):
        warm = {} if attempt else {"warm-up": True}
        made = ClipStream(generator, [attempt])
        for number, part in enumerate(given):
            begun, times = time.perf_counter(), []
            made.put([part])
            put_s = time.perf_counter() - begun
            for _ in made.take():
                times.append(time.perf_counter() - begun)
            line = {"chunk": number + 1, "frames": config.chunk_frames[number], **warm}
            yield {
                **line,
                "put_s": put_s,
                "first_frame_s": times[0],
                "last_frame_s": times[-1],
            }
        yield from ({**line, **warm} for line in _split_stream(generator, given, attempt))
        begun, times = time.perf_counter(), []
        for _ in generator.groups([clip], [attempt]):
            times.append(time.perf_counter() - begun)
        video_s = config.video.frames / config.video.fps
        yield {
            "ahead": attempt,
            **warm,
            "first_frame_s": times[0],
            "last_frame_s": times[-1],
            "video_s": video_s,
            "times_real_time": video_s / times[-1],
            "peak_gib": taken(),
        }


def _split_stream(
    generator: Generator, given: Sequence[Any], seed: int
) -> Iterator[dict[str, Any]]:
    """Yield the seconds of each part of each chunk. A part waits for the one before."""
    config, codec, denoiser = generator.config, generator.codec, generator.denoiser
    if codec is None or denoiser is None:
        raise SystemExit(f"{config.name} does not stream chunks.")
    line: dict[str, Any] = {}
    clip = timed(line, "text_s", lambda: generator.encode(pack_clip(given[:1], config)))
    noise = generator.noise([seed])
    channels: list[Any] = []
    latents = denoiser.latents(
        clip.text, clip.image, iter(lambda: channels.pop(), None), noise, last_32_bits([seed])
    )
    known, cache, seen = None, None, 0
    for number, part in enumerate(given):
        line = {**line, "chunk": number + 1}
        begun = time.perf_counter()
        videos = pack_videos([part], config, continued=number > 0)
        mask = videos.pop("mask", None)
        encoded, known = codec.encode(videos, known)
        size = config.chunks.sizes[number]
        made = replace(clip, mask=mask, **encoded)
        own = config.layout.condition_channels(made, noise[:, seen : seen + size])
        channels.append(jax.block_until_ready(own))
        line["conditions_s"] = time.perf_counter() - begun
        chunk = timed(line, "denoise_s", lambda: next(latents))
        begun = time.perf_counter()
        groups, cache = codec.decode(chunk, cache)
        jax.block_until_ready(groups)
        line["decode_s"] = time.perf_counter() - begun
        begun = time.perf_counter()
        frames = np.concatenate([np.asarray(group) for group, _ in groups], axis=1)[0]
        line["transfer_s"] = time.perf_counter() - begun
        timed(line, "wire_s", lambda f=frames: len(wire.pack({"frames": f})))
        needed = _chunk_flops(config, number)
        yield {**line, "pflop": needed / 1e15, **speed(needed, line["denoise_s"])}
        line, seen = {}, seen + size


def _predicted_stream(config: ModelConfig, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the memory and the roofline of each program, then the seconds of each chunk.

    All devices share a clip. `expected_s` of denoising is the model's FLOPs at `MFU`; the rest is
    at its roofline.
    """
    target = find(options.target)
    mesh = make_mesh(MeshConfig(data=1, fsdp=1, context=-1), target.devices)
    found: dict[str, Any] = {}
    for name, report in compile_generation(config, target, mesh, 1, streamed=True):
        known = isinstance(report, Report)
        needs = report.memory.peak if known else report.needs
        found[name] = report.roofline_s if known else math.nan
        yield {
            "program": name,
            "preflight_gib": needs / GIB,
            "fits": report.fits,
            "roofline_s": found[name],
        }
    for number, size in enumerate(config.chunks.sizes):
        same = config.chunk_frames.index(config.chunk_frames[number], min(number, 1))
        conditions = found[f"encode chunk {same + 1}"] + (found["encode"] if not number else 0)
        first, later = (0, size) if number else (1, size - 1)
        decode = first * found["decode 1"] + later * found.get("decode 2", 0.0)
        needed = _chunk_flops(config, number)
        rate = MFU * target.device.flops * len(target.devices)
        transfer = math.prod((config.chunk_frames[number], config.video.height)) * (
            3 * config.video.width / HOST_BYTES_S
        )
        denoise = found[f"chunk {number + 1}"]
        yield {
            "chunk": number + 1,
            "pflop": needed / 1e15,
            "conditions_s": conditions,
            "denoise_s": denoise,
            "decode_s": decode,
            "transfer_s": transfer,
            "at_least_s": conditions + denoise + decode + transfer,
            "expected_s": conditions + max(denoise, needed / rate) + decode + transfer,
        }


def _chunk_flops(config: ModelConfig, number: int) -> float:
    """Return the FLOPs of denoising a chunk of one clip, by its index."""
    chunks, (_, *cells) = config.chunks, config.latent_shape
    first = None if number else chunks.first_steps
    passes = (first or config.steps) + (chunks.refresh and number < len(chunks.sizes) - 1)
    one = config.dit.chunk_flops(
        latents=(chunks.sizes[number], *cells),
        seen=chunks.bounds[number],
        text=config.tokenizer.max_tokens,
        image=config.image_tokens,
    )
    return passes * one.total
