"""Batch generation: one clip for each window of a metadata file, in one folder.

    {id}.mp4            generated clip of a window
    {id}_cmp.mp4        prior | hands | generated | ground truth
    {id}_vae.mp4        ground truth through the autoencoder, on request
    results.jsonl       results; the last line of an id counts
    contact_sheet.png   the first clips

The noise of a clip depends only on the job's seed and the clip's id, not on order or batch.
"""

from __future__ import annotations

import hashlib
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jax.sharding import Mesh

from egosim_jax.conditioning.condition import Name as ConditionName
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.convert.lora import check_base
from egosim_jax.data.clip_files import prior_problem
from egosim_jax.data.clips import Policy, check_clip, load_triplet
from egosim_jax.data.metadata import check_presence
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.data.windows import RESULTS, Window, conditions_sha256, read_results
from egosim_jax.generation.encoding import batches
from egosim_jax.generation.generator import Generator
from egosim_jax.generation.stream import NonFiniteError
from egosim_jax.io.atomic import append_line
from egosim_jax.io.bounded import listing, quote
from egosim_jax.io.decoding import Decoding
from egosim_jax.io.digest import sha256_within
from egosim_jax.io.run import open_folder
from egosim_jax.io.video import read_video
from egosim_jax.io.weights import hashes
from egosim_jax.io.writing import write_video
from egosim_jax.rendering.mesh import hand_mask
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import print_line, printable
from egosim_jax.sharding import check_batch, make_mesh, parts
from egosim_jax.types import Clip, InputError, MeshConfig, Triplet

Baseline = Literal["no_hands", "hand_mask", "sdedit"]
"""Baseline that uses a model's weights with other conditions.

    no_hands    no hands: a video model of the scene alone (Wan-InP in EgoSim)
    hand_mask   silhouettes of the hands (DWM, Table 3)
    sdedit      from the noised prior, without prior, mask and hands (SDEdit, Meng et al. 2022; CVX
                SDEdit in DWM, Table 1)

The papers also train the models of the first two this way; weights trained with hands lose more.
"""
DROPPED: dict[Baseline, ConditionName | None] = {
    "no_hands": "hands", "hand_mask": None, "sdedit": "hands",
}  # fmt: skip
"""Condition that a baseline drops; a model with a `strength` drops prior and mask itself."""
STRENGTH = 0.75
"""Default fraction of the steps that SDEdit runs (DWM)."""
SHEET_CLIPS = 6
"""Maximum number of clips on the contact sheet."""
SHEET_COLUMNS = 6
"""Frames of each clip on the contact sheet."""
SHEET_ROWS = ("prior", "hands", "generated", "ground truth")
"""Rows of each clip on the contact sheet; the last one only if it is known."""
SHEET_WIDTH = 240
"""Width of a frame on the contact sheet in pixels."""
NO_TRUTH = (
    "without ground truth nothing can be reconstructed: add its video (column video), or omit "
    "--reconstruct."
)
"""Problem of a clip without ground truth."""

Failure = tuple[Window, str]
"""A window and why it failed."""


class Outcome(NamedTuple):
    """Number of windows of a batch job by outcome."""

    existing: int
    """Windows that were generated before."""
    done: int
    """Windows that were generated now."""
    rejected: int
    """Windows whose inputs are invalid."""
    failed: int
    """Windows whose generation failed."""


def seed_of(seed: int, output_id: str) -> int:
    """Return the seed of a clip's noise, given the seed of the job."""
    return int.from_bytes(hashlib.sha256(f"{seed} {output_id}".encode()).digest()[:4], "big")


@dataclass(frozen=True, kw_only=True)
class BatchJob:
    """Settings of a batch job; a job with equal settings resumes in the same folder."""

    model: ModelConfig
    """Config of the model."""
    out: Path
    """Folder of the generated clips and results.jsonl."""
    weights: Path | None
    """Folder of weights; None for random weights of `seed`."""
    lora: Path | None = None
    """LoRA of the denoiser: a file, or a folder that also has full weights (DWM)."""
    lora_scale: float = 1.0
    """Strength of the LoRA."""
    seed: int = 0
    """Seed from which each clip's noise is derived."""
    batch_size: int | None = None
    """Batch size over all devices; None: one clip for each shard of the batch."""
    mesh: MeshConfig = field(default_factory=lambda: MeshConfig(data=-1, fsdp=1))
    """Layout of the devices."""
    policy: Policy = "strict"
    """Treatment of invalid input (`data/clips.py`)."""
    decoding: Decoding = "accurate"
    """Color decoding of videos."""
    skip_existing: bool = False
    """Skip windows whose video is done; `InputError` if the video has other inputs."""
    reconstruct: bool = False
    """Also write the ground truth through the autoencoder."""
    baseline: Baseline | None = None
    """Baseline to generate instead of the model with all its conditions."""

    def open(self) -> None:
        """Record the settings in the folder. Raises `InputError` if it has another job's."""
        self._place()
        student, digests = self.model.chunks is not None, None
        if self.weights is not None:
            digests = hashes(self.weights, student=student)
        if self.lora is not None and digests is not None:
            check_base(self.lora, [digests["dit"]])
        settings = {
            "model": self.model,
            "weights": digests,
            "lora": None if self.lora is None else [sha256_within(self.lora), self.lora_scale],
            "seed": self.seed,
            "policy": self.policy,
            "decoding": self.decoding,
            "baseline": self.baseline,
        }
        open_folder(self.out, settings)
        for name, digest in (digests or {}).items():
            print(f"{self.model.name}: {name} sha256 {digest[:16]}", file=sys.stderr)

    def generate(
        self, windows: Sequence[Window], *, load: Callable[[Mesh], Generator] | None = None
    ) -> Outcome:
        """Check all inputs, compile, generate and draw; print the path of each new clip.

        `load` replaces `self.load`, for jobs that share a generator.
        """
        self._check_names(windows)
        skipped = self._finished(windows) if self.skip_existing else set()
        if skipped:
            print(f"{len(skipped)} existing clips are skipped", file=sys.stderr)
        todo = [window for window in windows if window.output_id not in skipped]
        valid, rejected = self.check(todo)
        for window, problem in rejected:
            self._report(window, status="failed", error=problem)
        failed: list[Failure] = []
        if valid:
            self._warn_of_long_prompts(valid)
            failed = self._generate(valid, load or self.load)
            self._draw(windows)
        outcome = Outcome(len(skipped), len(valid) - len(failed), len(rejected), len(failed))
        bad = outcome.rejected + outcome.failed
        print(printable(f"{outcome.done} done, {bad} failed: {self.out}"), file=sys.stderr)
        return outcome

    def _place(self) -> tuple[Mesh, int]:
        """Return the mesh and the batch size."""
        mesh = make_mesh(self.mesh)
        size = parts("batch", mesh) if self.batch_size is None else self.batch_size
        check_batch(size, mesh)
        return mesh, size

    def _check_names(self, windows: Sequence[Window]) -> None:
        """Raise `InputError` if two clips would write the same file."""
        owners: dict[str, str] = {}
        for window in windows:
            for suffix in ("", "_cmp", "_vae"):
                name = f"{window.output_id}{suffix}.mp4"
                other = owners.setdefault(name, window.output_id)
                if other != window.output_id:
                    raise InputError(
                        f"The clips {other} and {window.output_id} would both write {name}. Rename "
                        "one of them. (column video_id)"
                    )

    def _finished(self, windows: Sequence[Window]) -> set[str]:
        """Return the ids of the windows whose files exist and whose last result is `done`.

        Raises `InputError` if an existing clip has another source, prompt or other conditions:
        skipping its window would pass it off as the requested clip.
        """
        results, finished = read_results(self.out) or {}, set()
        for window in windows:
            line = results.get(window.output_id, {})
            files = [self._video(window)]
            if self.reconstruct:
                files.append(self._reconstruction(window))
            if line.get("status") != "done" or not all(path.exists() for path in files):
                continue
            expected = {"source_id": window.files.video_id, "start": window.start,
                   "prompt": window.files.prompt,
                   "conditions_sha256": conditions_sha256(window.files)}  # fmt: skip
            if differing := [name for name in expected if line.get(name) != expected[name]]:
                raise InputError(
                    f"{self._video(window)} exists and cannot be skipped, because it has another "
                    f"{differing[0]}: {quote(line.get(differing[0]))}, not "
                    f"{quote(expected[differing[0]])}. Choose another folder, or remove the clip. "
                    "(--out)"
                )
            finished.add(window.output_id)
        return finished

    def check(self, windows: Sequence[Window]) -> tuple[list[Window], list[Failure]]:
        """Return the valid windows, and the invalid ones with their problems."""
        if windows:
            check_presence([window.files for window in windows])
        valid, rejected = [], []
        for window in windows:
            problems = check_clip(
                window.files,
                self.model.video,
                start=window.start,
                policy=self.policy,
                grid=self.model.grid,
            )
            if problem := prior_problem(window.files.extra, self.model.prior):
                problems.append(f"{window.files.row} ({window.files.video_id}): {problem}")
            target = window.files.target
            if self.reconstruct and (target is None or not target.exists()):
                problems.append(NO_TRUTH)
            if problems:
                rejected.append((window, listing(problems)))
            else:
                valid.append(window)
        return valid, rejected

    def _warn_of_long_prompts(self, windows: Sequence[Window]) -> None:
        prompts = {window.files.video_id: window.files.prompt for window in windows}
        tokens = self.model.tokenizer.tokenize(list(prompts.values()))
        if tokens.cut:
            limit = self.model.tokenizer.max_tokens
            print(
                f"warning: {tokens.cut} of {len(prompts)} prompts are longer than {limit} tokens "
                f"(the longest has {max(tokens.lengths)}) and are cut",
                file=sys.stderr,
            )

    def _generate(
        self, windows: Sequence[Window], load: Callable[[Mesh], Generator]
    ) -> list[Failure]:
        """Generate batch after batch; return the failures."""
        mesh, size = self._place()
        unit = parts("batch", mesh)
        size = min(size, -(-len(windows) // unit) * unit)  # do not pad a short job further
        then = time.monotonic()
        generator = load(mesh)
        loaded = time.monotonic()
        generator.compile(size)
        print(
            f"weights in {loaded - then:.1f} s, programs in {time.monotonic() - loaded:.1f} s",
            file=sys.stderr,
        )
        failed: list[Failure] = []
        began, done = time.monotonic(), 0
        for batch in batches(windows, size):
            then = time.monotonic()
            triplets, problems = self._load(batch)
            failed += problems
            if triplets:
                with phase(f"generates {len(triplets)} clips", only_if_long=True):
                    failed += self._generate_batch(generator, triplets, size)
            done += len(batch)
            left = (time.monotonic() - began) / done * (len(windows) - done)
            print(
                f"{done}/{len(windows)} clips, {time.monotonic() - then:.1f} s, {left:.0f} s left",
                file=sys.stderr,
            )
        return failed

    def load(self, mesh: Mesh) -> Generator:
        """Return the generator of the job's weights, or of random weights from the job's seed."""
        if self.weights is None:
            print(f"{self.model.name}: random weights of seed {self.seed}", file=sys.stderr)
            return Generator(self.model, Networks.random(self.model, seed=self.seed), mesh)
        return Generator.load(
            self.model, self.weights, mesh=mesh, lora=self.lora, lora_scale=self.lora_scale
        )

    def _load(
        self, windows: Sequence[Window]
    ) -> tuple[list[tuple[Window, Triplet, str]], list[Failure]]:
        """Decode the inputs of a batch; return them with their hashes, and the failures."""
        loaded, failed = [], []
        for window in windows:
            try:
                digest = conditions_sha256(window.files)
                triplet = load_triplet(
                    window.files,
                    self.model.video,
                    start=window.start,
                    policy=self.policy,
                    decoding=self.decoding,
                    grid=self.model.grid,
                )
                self.model.layout.check_mask(triplet.mask)
                if self.reconstruct and triplet.target is None:  # it was there at the check
                    raise InputError(NO_TRUTH)
                loaded.append((window, triplet, digest))
            except (InputError, OSError) as error:  # such as a stale handle of a file server
                failed.append((window, str(error)))
                self._report(window, status="failed", error=str(error))
        return loaded, failed

    def _generate_batch(
        self, generator: Generator, loaded: Sequence[tuple[Window, Triplet, str]], size: int
    ) -> list[Failure]:
        """Generate and write one batch, padded to `size` so that nothing is recompiled."""
        windows, triplets, digests = zip(*loaded, strict=True)
        fill = size - len(windows)
        triplets = [*triplets, *[triplets[-1]] * fill]
        seeds = [seed_of(self.seed, w.output_id) for w in (*windows, *[windows[-1]] * fill)]
        then = time.monotonic()
        try:
            clips = self._clips(generator, triplets, seeds)
        except NonFiniteError as error:
            bad = {min(n, len(loaded) - 1) for n in error.bad}  # the padding repeats the last one
            problem = "The latents of the clip are not finite (NaN or infinity)."
            failed = [(windows[n], problem) for n in sorted(bad)]
            for window, _ in failed:
                self._report(window, status="failed", error=problem)
            good = [item for n, item in enumerate(loaded) if n not in bad]
            return failed + (self._generate_batch(generator, good, size) if good else [])
        seconds = (time.monotonic() - then) / len(windows)
        reconstructions = generator.reconstruct(triplets) if self.reconstruct else [None] * size
        # Not strict: `windows` and `digests` have no padding.
        for window, digest, triplet, clip, reconstruction, seed in zip(
            windows, digests, triplets, clips, reconstructions, seeds, strict=False
        ):
            self._write(window, triplet, clip, reconstruction)
            self._report(window, status="done", seed=seed, seconds=round(seconds, 3),
                         conditions_sha256=digest)  # fmt: skip
            print_line(self._video(window))
        return []

    def _clips(
        self, generator: Generator, triplets: Sequence[Triplet], seeds: Sequence[int]
    ) -> list[Clip]:
        if self.baseline == "hand_mask":
            triplets = [replace(triplet, hands=hand_mask(triplet.hands)) for triplet in triplets]
        return generator.generate(triplets, seeds, without=self.baseline and DROPPED[self.baseline])

    def _write(
        self, window: Window, triplet: Triplet, clip: Clip, reconstruction: Clip | None
    ) -> None:
        shown = [triplet.prior, triplet.hands, clip.frames]
        if triplet.target is not None:
            shown.append(triplet.target)
        comparison = np.concatenate(shown, axis=2)
        write_video(self.out / f"{window.output_id}_cmp.mp4", comparison, clip.fps)
        if reconstruction is not None:
            write_video(self._reconstruction(window), reconstruction.frames, clip.fps)
        write_video(self._video(window), clip.frames, clip.fps)

    def _report(self, window: Window, *, status: str, **values: Any) -> None:
        """Append a line to results.jsonl."""
        if status == "failed":
            problem = f"failed: {window.output_id}: {values['error']}"
            print(printable(problem), file=sys.stderr)
        record = {
            "video_id": window.output_id,
            "source_id": window.files.video_id,
            "start": window.start,
            "status": status,
            "output": f"{window.output_id}.mp4",
            **values,
            "prompt": window.files.prompt,
        }
        # A column of the metadata must not replace a field of the result.
        reserved = {*record, "seed", "seconds", "conditions_sha256", "error"}
        extra = window.files.extra.items()
        line = record | {f"metadata_{k}" if k in reserved else k: text for k, text in extra}
        append_line(self.out / RESULTS, line)

    def _video(self, window: Window) -> Path:
        return self.out / f"{window.output_id}.mp4"

    def _reconstruction(self, window: Window) -> Path:
        return self.out / f"{window.output_id}_vae.mp4"

    def _draw(self, windows: Sequence[Window]) -> None:
        """Draw the contact sheet of the first existing clips."""
        clips = list(itertools.islice(self._sheet_clips(windows), SHEET_CLIPS))
        if clips:
            last = self.model.video.frames - 1
            moments = np.linspace(0, last, SHEET_COLUMNS).round().astype(int)
            sheet = self.out / "contact_sheet.png"
            draw_sheet(clips, sheet, moments=moments.tolist(), width=SHEET_WIDTH)
            print_line(sheet)

    def _sheet_clips(self, windows: Sequence[Window]) -> Iterator[SheetClip]:
        for window in windows:
            if self._video(window).exists():
                videos = read_video(self.out / f"{window.output_id}_cmp.mp4").frames
                videos = np.split(videos, videos.shape[2] // self.model.video.width, axis=2)
                rows = dict(zip(SHEET_ROWS, videos, strict=False))
                yield SheetClip(f"{window.output_id}   {', '.join(rows)}", list(rows.values()))
