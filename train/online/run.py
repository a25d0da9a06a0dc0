"""The loop of online training: clips arrive, the denoiser and the decoder are updated in turn.

The learning rates follow the share of the run's time, or of its updates, that has passed: a linear
warm-up of `WARMUP` updates, then a cosine to a hundredth. Latents made beforehand (`latents`) are
read first, and as they arrive. Weights are written as parts of at most 16 MiB, at intervals and at
the end.
"""

from __future__ import annotations

import math
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.diffusion.objective import Objective
from egosim_jax.io import parts, weights
from egosim_jax.models.attention import Kernel
from egosim_jax.train.deepen import deepen_weights
from egosim_jax.train.metric_writers import JsonLines
from egosim_jax.train.online.latents import read_latents
from egosim_jax.train.online.pool import (
    CHUNK,
    Pool,
    latent_shapes,
    make_encode,
    raw_shapes,
    videos_of,
)
from egosim_jax.train.online.scenes import HELD_OUT, queued
from egosim_jax.train.online.updates import (
    Updater,
    make_decoder_update,
    make_denoiser_updates,
    make_generate,
    make_judge,
)
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.tasks.refining import Refining

WARMUP = 300
"""Updates of linear warm-up of the denoiser; the decoder has a third."""


@dataclass(frozen=True, kw_only=True)
class OnlineTraining:
    """Settings of an online training."""

    model: ModelConfig
    """Model to train."""
    start: Path
    """Folder of the weights to start from; a shallower denoiser is deepened."""
    out: Path
    """Folder of the run."""
    minutes: float | None = None
    """Duration, compilation included; None: by `updates`."""
    updates: int | None = None
    """Number of the denoiser's updates; the run ends at the first of both limits."""
    workers: int = 0
    """Number of processes that make scenes; 0: train on the given latents only."""
    first_scene: int = 2_000_000
    """Seed of the first scene."""
    held_out: int = 48
    """Number of validation scenes, of the seeds from 0."""
    latents: Path | None = None
    """Folder of latents made beforehand, which may still grow (`latents.py`)."""
    batch: int = 128
    """Clips of a denoiser's update."""
    per_program: int = 8
    """Updates of the denoiser in one program."""
    learning_rate: float = 1.2e-3
    """Peak learning rate of the denoiser."""
    weight_decay: float = 0.05
    """Its weight decay."""
    ema_decay: float = 0.9995
    """Decay of its moving average."""
    decoder_share: float = 0.25
    """Share of the device's time for the decoder; 0: the decoder stays."""
    decoder_batch: int = 6
    """Clips of a decoder's update."""
    decoder_rate: float = 1e-3
    """Peak learning rate of the decoder."""
    decoder_ema: float = 0.998
    """Decay of its moving average."""
    generated: float = 0.5
    """Fraction of the decoder's latents that the denoiser generated, from a third of the run on."""
    clips: int = 12288
    """Capacity of the pool of latents."""
    frames: int = 3072
    """Capacity of the pool of frames."""
    seed: int = 0
    """Seed of the batches and the noise."""
    log_s: float = 10.0
    """Seconds between log lines."""
    validate_s: float = 75.0
    """Seconds between validations."""
    save_s: float = 120.0
    """Seconds between writings of the weights."""
    kernels: tuple[Kernel, ...] = ("auto",)
    """Attention kernels to try, the likely fastest first."""
    compiler: Mapping[str, Any] = field(default_factory=dict)
    """Options of the compiler that save time for convolutions; the default ones are tried too."""
    graphs: Mapping[str, Any] = field(default_factory=dict)
    """Options of the compiler to try for the denoiser, with the first kernel."""

    @property
    def denoising(self) -> Denoising:
        """Task of the denoiser."""
        dropout = ConditionDropout(prior=0.05, mask=0.05, hands=0.05, text=0.05)
        steps = self.model.steps
        return Denoising(
            model=self.model,
            objective=Objective(sampler_steps=steps if isinstance(steps, int) else None),
            dropout=dropout,
            change_loss_weight=4.0,
        )

    @property
    def refining(self) -> Refining:
        """Task of the decoder."""
        return Refining(
            vae=self.model.vae,
            video=self.model.video,
            crop=(self.model.video.height, self.model.video.width),
            part="decoder",
            motion_weight=4.0,
        )


class Choice:
    """Forms of one program: the first that is compiled runs, until a faster one is ready."""

    def __init__(self, forms: Mapping[str, Future[Any]]):
        self.waiting = dict(forms)
        self.label, self.seconds = "", math.inf
        self.program: Any = None

    def consider(self, trial: Callable[[Any], float]) -> list[str]:
        """Take the fastest of the forms that are compiled; return a line for each new one.

        `trial` runs a program and returns its seconds; it runs the present one again, too.
        """
        ready = [label for label, task in self.waiting.items() if task.done()]
        lines = []
        for label in ready:
            task = self.waiting.pop(label)
            if problem := task.exception():
                lines.append(f"{label}: {type(problem).__name__}: {str(problem)[:200]}")
                continue
            if self.program is not None:
                self.seconds = trial(self.program)
            seconds = trial(task.result())
            lines.append(f"{label}: {1e3 * seconds:.1f} ms, {self.label}: {1e3 * self.seconds:.1f}")
            if seconds < self.seconds:
                self.label, self.seconds, self.program = label, seconds, task.result()
        return lines


class Clips(threading.Thread):
    """Reader of the queue: chunks of raw clips, and the held-out ones."""

    def __init__(self, folder: Path):
        super().__init__(daemon=True)
        self.folder, self.chunks = folder, queue.Queue(maxsize=4)
        self.held: list[Mapping[str, np.ndarray]] = []

    def run(self) -> None:
        """Read files as they appear."""
        rows: list[Mapping[str, np.ndarray]] = []
        while self.folder.is_dir():
            for path in queued(self.folder):
                with np.load(path) as file:
                    row = dict(file)
                path.unlink()
                if path.name.startswith(HELD_OUT):
                    self.held.append(row)
                    continue
                rows.append(row)
                if len(rows) == CHUNK:
                    self.chunks.put(stacked(rows))
                    rows = []
            time.sleep(0.1)


def stacked(rows: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return rows as one array each."""
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


class OnlineRun:
    """A running online training."""

    def __init__(self, plan: OnlineTraining):
        self.plan, self.began = plan, time.monotonic()
        plan.out.mkdir(parents=True, exist_ok=True)
        self.log = JsonLines(plan.out / "metrics.jsonl", resume_after=0)
        model = plan.model
        start = deepen_weights(plan.start, model.dit.layers, plan.out / "start")
        only = (*model.trained_networks, "vae")
        self.networks = nnx.eval_shape(lambda: Networks.build(model, only=only, rngs=nnx.Rngs(0)))
        for name in only:
            weights.load(start / f"{name}.safetensors", getattr(self.networks, name))
        vae, self.networks.vae = self.networks.vae, None
        self.vae = nnx.state(vae)
        self.graph, params = nnx.split(self.networks)
        self.denoiser = Updater(weight_decay=plan.weight_decay, ema_decay=plan.ema_decay)
        self.state = self.denoiser.create(params)
        trained = plan.refining.trained
        self.vae_graph, decoder, self.frozen = nnx.split(Networks(vae=vae), trained, ...)
        self.decoder = Updater(ema_decay=plan.decoder_ema)
        self.decoder_state = self.decoder.create(decoder)
        self.pool = Pool(latent_shapes(model, plan.clips))
        self.frames = Pool(self._frame_shapes())
        self.read: set[Path] = set()
        self.held: dict[str, np.ndarray] = {}

    def _frame_shapes(self) -> dict[str, jax.ShapeDtypeStruct]:
        count, model = self.plan.frames, self.plan.model
        latents = latent_shapes(model, count)["target"]
        return {
            "frames": raw_shapes(model, count)["target"],
            "latents": latents,
            "generated": latents,
            "row": jax.ShapeDtypeStruct((count,), np.int32),
        }

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.began

    def train(self) -> None:
        """Train until the end, and write the weights."""
        plan = self.plan
        with TemporaryDirectory(dir=shared_memory()) as folder:
            clips, processes = Clips(Path(folder)), []
            try:
                processes = start_workers(plan, Path(folder))
                clips.start()
                self._compile()
                self._wait_for_clips(clips)
                self._loop(clips)
            finally:
                for process in processes:
                    process.kill()
        self.save()
        self._say(validation=self.validate(clips.held), done=True)

    def _compile(self) -> None:
        """Compile the programs side by side; those that no update needs may come later."""
        plan, state, decoder, rows = self.plan, self.state, self.decoder_state, np.int32(1)
        one, pool, frames = np.float32(1), self.pool.arrays, self.frames.arrays
        raw = raw_shapes(plan.model, CHUNK)
        latents = latent_shapes(plan.model, CHUNK)
        for name in videos_of(plan.model):
            latents[name] = jax.ShapeDtypeStruct(latents[name].shape, np.float32)
        latents["pixels"] = raw["pixels"]
        update = make_decoder_update(
            plan.refining, self.decoder, self.vae_graph, batch=plan.decoder_batch, seed=plan.seed
        )
        generate = make_generate(plan.model, self.graph, batch=self.chunk)
        judge = make_judge(plan.denoising, self.graph, self.vae_graph, CHUNK)
        encode = make_encode(plan.model, nnx.merge(self.vae_graph, decoder.params, self.frozen).vae)
        rates = np.zeros(plan.per_program, np.float32)
        first, *others = plan.kernels
        forms = {"updates": (first, {})}
        if plan.graphs:
            forms["updates, graphs"] = (first, plan.graphs)
        forms |= {f"updates, {kernel}": (kernel, {}) for kernel in others}
        denoisers = {
            name: (self._updates(kernel), options, state, pool, rows, rates)
            for name, (kernel, options) in forms.items()
        }
        arguments = (decoder, self.frozen, frames, rows, one, one)
        calls: dict[str, tuple] = {
            "encode": (encode, plan.compiler, self.vae, raw),
            "decoder": (update, plan.compiler, *arguments),
            "generate": (
                generate, {}, state.average, pool, frames["row"], frames["generated"], rows, rows,
            ),
            "judge": (
                judge, plan.compiler, state.average, decoder.average, self.frozen, latents,
                raw["target"],
            ),
        }  # fmt: skip
        if plan.compiler:
            calls["decoder, searched"] = (update, {}, *arguments)
        if not plan.decoder_share:
            calls = {name: calls[name] for name in ("encode", "judge")}
        # Two at a time, in order: what is needed first is not slowed down by what can wait.
        self.tasks = {}
        for group in (denoisers, calls):
            executor = ThreadPoolExecutor(1)
            for name, call in group.items():
                self.tasks[name] = executor.submit(self._compiled, name, *call)
            executor.shutdown(wait=False)
        self.updates = Choice({name: self.tasks[name] for name in denoisers})
        self.decode = Choice({n: task for n, task in self.tasks.items() if "decoder" in n})
        self.encode = self.tasks["encode"].result()

    def _updates(self, kernel: Kernel) -> Any:
        """Return the denoiser's jitted updates with an attention kernel."""
        plan = self.plan
        model = replace(plan.model, dit=replace(plan.model.dit, attention=kernel))
        only = model.trained_networks
        networks = nnx.eval_shape(lambda: Networks.build(model, only=only, rngs=nnx.Rngs(0)))
        return make_denoiser_updates(
            replace(plan, model=model).denoising,
            self.denoiser,
            nnx.graphdef(networks),
            batch=plan.batch,
            count=plan.per_program,
            seed=plan.seed,
        )

    def _compiled(self, name: str, jitted: Any, options: Mapping[str, Any], *args: Any) -> Any:
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), args)
        program = jitted.lower(*shapes).compile(compiler_options=dict(options) or None)
        self._say(compiled=name)
        return program

    def _ready(self, name: str) -> Any:
        """Return a program, or None while it is being compiled or if it cannot be."""
        task = self.tasks.get(name)
        if task is None or not task.done():
            return None
        if problem := task.exception():
            self._say(failed=name, problem=str(problem)[:200])
            del self.tasks[name]
            return None
        return task.result()

    def _wait_for_clips(self, clips: Clips) -> None:
        self._admit(clips, limit=10**6)
        while len(self.pool) < min(4 * CHUNK, self.plan.clips):
            time.sleep(0.2)
            self._admit(clips, limit=8)

    def _admit(self, clips: Clips, *, limit: int) -> None:
        """Store latents made beforehand and encoded clips that have arrived."""
        if self.plan.latents is not None:
            for rows in read_latents(self.plan.latents, self.read, self.plan.model, limit=limit):
                self.pool.append(rows)
        for _ in range(limit):
            try:
                raw = clips.chunks.get_nowait()
            except queue.Empty:
                return
            rows = self.encode(self.vae, raw)
            at = np.arange(CHUNK, dtype=np.int32) + self.pool.position
            self.pool.append(rows)
            latents = rows["target"]
            self.frames.append(
                {"frames": raw["target"], "latents": latents, "generated": latents, "row": at}
            )

    def _loop(self, clips: Clips) -> None:
        plan = self.plan
        self._await_updates()
        first = logged = validated = saved = self.seconds
        refreshed, rate, counted = 0.0, 0.0, (0, 0)
        self.done = self.decoded = 0
        self.decoder_first: float | None = None
        pending: list[Mapping[str, jax.Array]] = []
        while (share := self._share(first, self.done)) < 1:
            for line in self.updates.consider(partial(self._trial, self._update, share)):
                self._say(step=self.done, form=line)
            metrics = self._update(self.updates.program, share)
            rate = plan.learning_rate * schedule(share)
            if len(self.frames) >= min(plan.frames, 8 * CHUNK):
                for line in self.decode.consider(partial(self._trial, self._decode, share)):
                    self._say(step=self.done, form=line)
                for _ in range(self._decoder_updates()):
                    others = self._decode(self.decode.program, share, generated=refreshed > 0)
                    metrics = {**metrics, **{f"decoder_{k}": v for k, v in others.items()}}
            pending.append(metrics)
            if len(pending) > 2:
                jax.block_until_ready(pending[-3]["loss"])  # two programs wait on the device
            self._admit(clips, limit=2)
            now, generate = self.seconds, self._ready("generate")
            if self.decoded and generate and share > 1 / 3 and now - refreshed > 30:
                self._refresh(generate)
                refreshed = now
            if now - logged > plan.log_s:
                paces = [
                    (n - m) / (now - logged)
                    for n, m in zip((self.done, self.decoded), counted, strict=True)
                ]
                self._say(
                    **means(pending),
                    step=self.done,
                    rate=rate,
                    clips=self.pool.appended,
                    queue=clips.chunks.qsize(),
                    updates_per_s=paces[0],
                    decoder_per_s=paces[1],
                )
                pending, logged, counted = pending[-2:], now, (self.done, self.decoded)
            if now - validated > plan.validate_s:
                validated = now
                self._say(step=self.done, validation=self.validate(clips.held))
            if now - saved > plan.save_s:
                saved = now
                self.save()
        self._say(step=self.done, decoder_step=self.decoded, skipped=int(self.state.skipped))

    def _await_updates(self) -> None:
        """Wait until a form of the denoiser's updates is compiled. Raises if none can be."""
        while not any(
            task.done() and not task.exception() for task in self.updates.waiting.values()
        ):
            if all(task.done() for task in self.updates.waiting.values()):
                self.tasks["updates"].result()
            time.sleep(0.1)

    def _update(self, program: Any, share: float) -> Mapping[str, jax.Array]:
        """Run a program of the denoiser's updates."""
        plan = self.plan
        steps = self.done + 1 + np.arange(plan.per_program)
        rates = plan.learning_rate * schedule(share) * np.minimum(1, steps / WARMUP)
        rows = np.int32(len(self.pool))
        self.state, metrics = program(self.state, self.pool.arrays, rows, rates.astype(np.float32))
        self.done += plan.per_program
        return metrics

    def _decode(
        self, program: Any, share: float, generated: bool = False
    ) -> Mapping[str, jax.Array]:
        """Run an update of the decoder."""
        plan = self.plan
        if self.decoder_first is None:
            self.decoder_first = share
        part = (share - self.decoder_first) / (1 - self.decoder_first)
        warm = min(1.0, 3 * (self.decoded + 1) / WARMUP)
        self.decoder_state, metrics = program(
            self.decoder_state,
            self.frozen,
            self.frames.arrays,
            np.int32(len(self.frames)),
            np.float32(plan.generated if generated else 0),
            np.float32(plan.decoder_rate * schedule(part) * warm),
        )
        self.decoded += 1
        return metrics

    def _trial(self, run: Callable[..., Any], share: float, program: Any) -> float:
        """Return the seconds of a program: four runs, the first not counted.

        They are updates of the run. A program that fails has infinite seconds and changes nothing.
        """
        before = jax.tree.map(jnp.copy, (self.state, self.decoder_state)), self.done, self.decoded
        try:
            jax.block_until_ready(run(program, share))
            began = time.monotonic()
            for _ in range(3):
                metrics = run(program, share)
            jax.block_until_ready(metrics)
        except jax.errors.JaxRuntimeError as problem:
            self._say(step=self.done, failed=str(problem)[:200])
            (self.state, self.decoder_state), self.done, self.decoded = before
            return math.inf
        return (time.monotonic() - began) / 3

    def _decoder_updates(self) -> int:
        """Return the number of decoder updates beside one program of the denoiser's."""
        if self.decode.program is None:
            return 0
        ratio = self.plan.decoder_share / (1 - self.plan.decoder_share)
        return max(1, round(ratio * self.updates.seconds / self.decode.seconds))

    def _share(self, first: float, done: int) -> float:
        """Return the share of the run that has passed, of its time or of its updates."""
        shares = []
        if self.plan.minutes is not None:
            shares.append((self.seconds - first) / max(1.0, 60 * self.plan.minutes - first))
        if self.plan.updates is not None:
            shares.append(done / self.plan.updates)
        return max(shares)

    def _refresh(self, generate: Any) -> None:
        """Generate the latents of the frame pool anew."""
        frames, seed = self.frames.arrays, np.int32(self.seconds)
        for start in range(0, len(self.frames), self.chunk):
            frames["generated"] = generate(
                self.state.average,
                self.pool.arrays,
                frames["row"],
                frames["generated"],
                np.int32(start),
                seed,
            )

    @property
    def chunk(self) -> int:
        """Number of clips that are generated at a time."""
        return math.gcd(self.plan.frames, 128)

    def validate(self, held: list[Mapping[str, np.ndarray]]) -> dict[str, float]:
        """Return the denoiser's loss, and PSNR and LPIPS of decoded and of generated clips."""
        count, judge = len(held) // CHUNK * CHUNK, self._ready("judge")
        if not count or judge is None:
            return {}
        totals: dict[str, float] = {}
        for start in range(0, count, CHUNK):
            raw = stacked(held[start : start + CHUNK])
            found = judge(
                self.state.average,
                self.decoder_state.average,
                self.frozen,
                self.encode(self.vae, raw),
                raw["target"],
            )
            for name, value in jax.device_get(found).items():
                totals[name] = totals.get(name, 0.0) + float(value) * CHUNK / count
        return totals

    def save(self) -> None:
        """Write the averaged weights of all networks, as parts of at most 16 MiB."""
        networks = nnx.merge(self.graph, self.state.average)
        networks.vae = nnx.merge(self.vae_graph, self.decoder_state.average, self.frozen).vae
        with TemporaryDirectory(dir=self.plan.out) as folder:
            networks.save(Path(folder), dtype="float16")
            files = sorted(Path(folder).glob("*.safetensors"))
            parts.cut(files, self.plan.out / "weights")

    def _say(self, *, validation: Mapping[str, float] | None = None, **values: Any) -> None:
        values = {**values, **{f"validation_{n}": v for n, v in (validation or {}).items()}}
        step = values.pop("step", int(values.pop("done", 0)))
        numbers = "  ".join(
            f"{n} {v:.4g}" if isinstance(v, float) else f"{n} {v}" for n, v in values.items()
        )
        print(f"{self.seconds:7.1f} s  step {step:>6}  {numbers}", file=sys.stderr, flush=True)


def schedule(share: float) -> float:
    """Return the learning rate after the warm-up as a share of its peak."""
    return max(0.01, 0.5 * (1 + math.cos(math.pi * share)))


def means(rows: list[Mapping[str, jax.Array]]) -> dict[str, float]:
    """Return the mean of each metric over the rows that have it."""
    found: dict[str, list[float]] = {}
    for row in jax.device_get(rows):
        for name, value in row.items():
            found.setdefault(name, []).append(float(value))
    return {name: float(np.mean(values)) for name, values in found.items()}


def start_workers(plan: OnlineTraining, folder: Path) -> list[subprocess.Popen]:
    """Start the processes that make scenes, first the held-out ones."""
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", **dict.fromkeys(threads, "1")}
    command = [sys.executable, "-m", "egosim_jax.train.online.scenes"]
    command += ["--config", plan.model.name, "--queue", str(folder)]
    command += ["--stride", str(plan.workers), "--held-out", str(plan.held_out), "--first"]
    log = (plan.out / "scenes.log").open("a")
    return [
        subprocess.Popen(
            [*command, str(plan.first_scene + number)], env=environment, stderr=log, stdout=log
        )
        for number in range(plan.workers)
    ]


def shared_memory() -> str | None:
    """Return a folder in memory, or None where there is none."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None
