"""The loop of online training: clips arrive, the denoiser and the decoder are updated in turn.

The learning rates follow the share of the run's time, or of its updates, that has passed: a linear
warm-up of `WARMUP` updates, then a cosine to a hundredth. Latents made beforehand (`latents`) are
read first, and as they arrive. Weights and checkpoints are written at intervals and at the end: the
same command resumes an interrupted run. It waits for clips
again, because checkpoints have none.
"""

from __future__ import annotations

import math
import queue
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
from flax import nnx

from egosim_jax.configs.model import Networks
from egosim_jax.data.records import stacked
from egosim_jax.io import weights
from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.checkpoint import Checkpoints
from egosim_jax.train.metric_writers import JsonLines
from egosim_jax.train.online.latents import read_latents
from egosim_jax.train.online.plan import OnlineTraining, Progress
from egosim_jax.train.online.pool import (
    CHUNK,
    Pool,
    latent_shapes,
    make_encode,
    raw_shapes,
    videos_of,
)
from egosim_jax.train.online.scenes import Clips, start_workers
from egosim_jax.train.online.updates import (
    create,
    make_decoder_update,
    make_denoiser_updates,
    make_generate,
    make_judge,
    muon,
)
from egosim_jax.types import InputError

WARMUP = 300
"""Updates of linear warm-up of the denoiser; the decoder has a third."""


class OnlineRun:
    """A running online training."""

    def __init__(self, plan: OnlineTraining):
        self.plan, self.began = plan, time.monotonic()
        plan.out.mkdir(parents=True, exist_ok=True)
        model = plan.model
        only = (*model.trained_networks, "vae")
        self.networks = nnx.eval_shape(lambda: Networks.build(model, only=only, rngs=nnx.Rngs(0)))
        for name in only:
            weights.load(plan.start / f"{name}.safetensors", getattr(self.networks, name))
        vae: Any = self.networks.vae
        self.networks = Networks(
            dit=self.networks.dit, text=self.networks.text, image=self.networks.image
        )
        self.vae = nnx.state(vae)
        self.graph, params = nnx.split(self.networks)
        self.denoiser = muon(
            weight_decay=plan.weight_decay, ema_decay=plan.ema_decay, batch=plan.batch
        )
        self.state = create(params, self.denoiser)
        trained = plan.refining.trained
        self.vae_graph, decoder, self.frozen = nnx.split(Networks(vae=vae), trained, ...)
        self.decoder = muon(ema_decay=plan.decoder_ema, batch=plan.decoder_batch)
        self.decoder_state = create(decoder, self.decoder)
        self.pool = Pool(latent_shapes(model, plan.clips))
        self.frames = Pool(self._frame_shapes())
        self.read: set[Path] = set()
        self.progress = Progress()
        self.checkpoints = Checkpoints(plan.out / "checkpoints")
        if self.checkpoints.steps:
            states = {"denoiser": self.state, "decoder": self.decoder_state}
            states = self.checkpoints.restore(states, self.progress, fallback=True)
            self.state, self.decoder_state = states["denoiser"], states["decoder"]
            self.began -= self.progress.seconds
        self.skipped: Any = self.progress.skipped
        self.log = JsonLines(plan.out / "metrics.jsonl", resume_after=self.progress.done)

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
        with TemporaryDirectory(dir=plan.out) as folder:
            clips, processes = Clips(Path(folder)), []
            try:
                processes = start_workers(plan, Path(folder), made=self.progress.arrived)
                clips.start()
                self._compile()
                self._wait_for_clips(clips)
                self._loop(clips)
                self.save()
            finally:
                for process in processes:
                    process.kill()
                self.checkpoints.close()
        self._say(step=self.progress.done, validation=self.validate(clips.held))

    def _compile(self) -> None:
        """Compile the programs side by side; those that no update needs may come later."""
        plan, state, decoder, rows = self.plan, self.state, self.decoder_state, np.int32(1)
        one, pool, frames = np.float32(1), self.pool.arrays, self.frames.arrays
        raw, latents = raw_shapes(plan.model, CHUNK), latent_shapes(plan.model, CHUNK)
        for name in (*videos_of(plan.model), "pixels"):
            latents[name] = jax.ShapeDtypeStruct(latents[name].shape, np.float32)
        updates = make_denoiser_updates(
            plan.denoising, self.denoiser, self.graph, count=plan.per_program, seed=plan.seed
        )
        update = make_decoder_update(plan.refining, self.decoder, self.vae_graph, seed=plan.seed)
        encode = make_encode(plan.model, nnx.merge(self.vae_graph, decoder.params, self.frozen).vae)
        generate = make_generate(plan.model, self.graph, batch=self.chunk)
        judge = make_judge(plan.denoising, self.graph, self.vae_graph, CHUNK)
        rates = np.zeros(plan.per_program, np.float32)
        calls: dict[str, tuple] = {
            "updates": (updates, state, pool, rows, rates),
            "encode": (encode, self.vae, raw),
            "decoder": (update, decoder, self.frozen, frames, rows, one, one),
            "generate": (
                generate, state.eval_params, pool, frames["row"], frames["generated"], rows, rows,
            ),
            "judge": (
                judge, state.eval_params, decoder.eval_params, self.frozen, latents, raw["target"],
            ),
        }  # fmt: skip
        if not plan.decoder_share:
            del calls["decoder"], calls["generate"]
        executor = ThreadPoolExecutor(2)  # in order: the programs needed first do not wait
        self.tasks = {
            name: executor.submit(self._compiled, name, *call) for name, call in calls.items()
        }
        executor.shutdown(wait=False)
        self.updates, self.encode = (self.tasks[name].result() for name in ("updates", "encode"))

    def _compiled(self, name: str, jitted: Any, *args: Any) -> Any:
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), args)
        program = jitted.lower(*shapes).compile()
        self._say(compiled=name)
        return program

    def _ready(self, name: str) -> Any:
        """Return a program, or None while it is being compiled."""
        task = self.tasks.get(name)
        return task.result() if task is not None and task.done() else None

    def _wait_for_clips(self, clips: Clips) -> None:
        self._admit(clips, limit=10**6)
        while len(self.pool) < (wanted := min(self.plan.first_clips, self.plan.clips)):
            if not self.plan.workers:
                raise InputError(
                    f"There are {len(self.pool)} clips and no process makes more: {wanted} must be "
                    "there before the first update. (--latents, --workers, --first-clips)"
                )
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
            self.progress.arrived += CHUNK
            at = np.arange(CHUNK, dtype=np.int32) + self.pool.position
            self.pool.append(rows)
            latents = rows["target"]
            self.frames.append(
                {"frames": raw["target"], "latents": latents, "generated": latents, "row": at}
            )

    def _loop(self, clips: Clips) -> None:
        plan, progress = self.plan, self.progress
        logged = validated = saved = self.seconds
        if progress.first is None:
            progress.first = self.seconds
        refreshed, rate, counted = 0.0, 0.0, (progress.done, progress.decoded)
        pending: list[Mapping[str, jax.Array]] = []
        while (share := self._share()) < 1:
            metrics = self._update(share)
            rate = plan.learning_rate * schedule(share)
            if self._ready("decoder") and len(self.frames) >= min(plan.frames, 8 * CHUNK):
                for _ in range(self._decoder_updates(share)):
                    others = self._decode(share, generated=refreshed > 0)
                    metrics = {**metrics, **{f"decoder_{k}": v for k, v in others.items()}}
            pending.append(metrics)
            if len(pending) > 2:
                jax.block_until_ready(pending[-3]["loss"])  # two programs wait on the device
            self._admit(clips, limit=2)
            now, generate = self.seconds, self._ready("generate")
            if progress.decoded and generate and share > 1 / 3 and now - refreshed > 30:
                self._refresh(generate)
                refreshed = now
            if now - logged > plan.log_s:
                paces = [
                    (n - m) / (now - logged)
                    for n, m in zip((progress.done, progress.decoded), counted, strict=True)
                ]
                self._say(
                    values=means(pending),
                    step=self.progress.done,
                    rate=rate,
                    clips=self.pool.appended,
                    queue=clips.chunks.qsize(),
                    updates_per_s=paces[0],
                    decoder_per_s=paces[1],
                )
                pending, logged, counted = pending[-2:], now, (progress.done, progress.decoded)
            if now - validated > plan.validate_s:
                validated = now
                self._say(step=self.progress.done, validation=self.validate(clips.held))
            if now - saved > plan.save_s:
                saved = now
                self.save()
        self._say(
            step=self.progress.done,
            decoder_step=self.progress.decoded,
            skipped=int(self.skipped),
        )

    def _update(self, share: float) -> Mapping[str, jax.Array]:
        """Run a program of the denoiser's updates."""
        plan = self.plan
        steps = self.progress.done + 1 + np.arange(plan.per_program)
        rates = plan.learning_rate * schedule(share) * np.minimum(1, steps / WARMUP)
        rows = np.int32(len(self.pool))
        self.state, skipped, metrics = self.updates(
            self.state, self.pool.arrays, rows, rates.astype(np.float32)
        )
        self.skipped = self.skipped + skipped  # on the device, which nothing waits for
        self.progress.done += plan.per_program
        return metrics

    def _decode(self, share: float, *, generated: bool = False) -> Mapping[str, jax.Array]:
        """Run an update of the decoder."""
        plan = self.plan
        if self.progress.decoder_first is None:
            self.progress.decoder_first = share
        first = self.progress.decoder_first
        part = (share - first) / (1 - first)
        warm = min(1.0, 3 * (self.progress.decoded + 1) / WARMUP)
        self.decoder_state, metrics = self._ready("decoder")(
            self.decoder_state,
            self.frozen,
            self.frames.arrays,
            np.int32(len(self.frames)),
            np.float32(plan.generated if generated else 0),
            np.float32(plan.decoder_rate * schedule(part) * warm),
        )
        self.progress.decoded += 1
        return metrics

    def _decoder_updates(self, share: float) -> int:
        """Return the number of decoder updates next to one program of the denoiser's."""
        if self.progress.pace is None:  # both are timed once
            seconds = [_seconds(run, share) for run in (self._update, self._decode)]
            ratio = self.plan.decoder_share / (1 - self.plan.decoder_share)
            self.progress.pace = max(1, round(ratio * seconds[0] / seconds[1]))
            self._say(step=self.progress.done, program_s=seconds[0], decoder_s=seconds[1])
        return self.progress.pace

    def _share(self) -> float:
        """Return the share of the run that has passed, of its time or of its updates."""
        shares, first, done = [], self.progress.first or 0.0, self.progress.done
        if self.plan.minutes is not None:
            shares.append((self.seconds - first) / max(1.0, 60 * self.plan.minutes - first))
        if self.plan.updates is not None:
            shares.append(done / self.plan.updates)
        return max(shares)

    def _refresh(self, generate: Any) -> None:
        """Generate the latents of the frame pool again."""
        frames, seed = self.frames.arrays, np.int32(self.seconds)
        for start in range(0, len(self.frames), self.chunk):
            frames["generated"] = generate(
                self.state.eval_params,
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
                self.state.eval_params,
                self.decoder_state.eval_params,
                self.frozen,
                self.encode(self.vae, raw),
                raw["target"],
            )
            for name, value in jax.device_get(found).items():
                totals[name] = totals.get(name, 0.0) + float(value) * CHUNK / count
        return totals

    def save(self) -> None:
        """Write the averaged weights of all networks, and a checkpoint.

        The checkpoint is written in the background.
        """
        if self.progress.done not in self.checkpoints.steps:
            self.progress.seconds, self.progress.skipped = self.seconds, int(self.skipped)
            states = {"denoiser": self.state, "decoder": self.decoder_state}
            self.checkpoints.save(self.progress.done, states, self.progress)
        trained = nnx.merge(self.graph, self.state.eval_params)
        vae: Any = nnx.merge(self.vae_graph, self.decoder_state.eval_params, self.frozen).vae
        networks = Networks(dit=trained.dit, text=trained.text, image=trained.image, vae=vae)
        with atomic_folder(self.plan.out / "weights") as folder:
            networks.save(folder, dtype="float16")

    def _say(
        self,
        *,
        step: int = 0,
        values: Mapping[str, float] | None = None,
        validation: Mapping[str, float] | None = None,
        **others: Any,
    ) -> None:
        """Print values, and log those that are numbers."""
        found = {f"validation_{name}": value for name, value in (validation or {}).items()}
        values = {**(values or {}), **found, **others}
        numbers = {n: float(v) for n, v in values.items() if isinstance(v, int | float)}
        self.log.write(step, {"seconds": self.seconds, **numbers})
        line = "  ".join(
            f"{n} {v:.4g}" if isinstance(v, float) else f"{n} {v}" for n, v in values.items()
        )
        print(f"{self.seconds:7.1f} s  step {step:>6}  {line}", file=sys.stderr, flush=True)


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


def _seconds(run: Callable[[float], Any], share: float) -> float:
    """Return the seconds of one of the run's calls: four are made, the first is not counted."""
    jax.block_until_ready(run(share))
    began = time.monotonic()
    jax.block_until_ready([run(share) for _ in range(3)])
    return (time.monotonic() - began) / 3
