"""`egosim generate`: clips from a metadata file of conditions."""

from __future__ import annotations

import hashlib
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from egosim_jax.command import DONE, PARTIAL, USAGE
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.io.atomic import append_line
from egosim_jax.io.untrusted import listing, read_lines
from egosim_jax.types import Clip, InputError, MeshConfig, Triplet, check_counts, check_seed

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from egosim_jax.data.metadata import ClipFiles
    from egosim_jax.generator import Generator
    from egosim_jax.networks import ModelConfig

RESULTS = "results.jsonl"
SHEET_CLIPS, SHEET_COLUMNS, SHEET_WIDTH = 6, 6, 240
"""Of the contact sheet: clips, moments of each, and pixels of a picture's width."""


Solver = Literal["euler", "unipc", "wan", "ddim", "dpmpp_2m", "dpmpp_2m_sde"]


@dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate a clip for each row of a metadata file, or of a scene of the tabletop world.

    Writes {id}.mp4, {id}_cmp.mp4 (prior | hands | generated | truth), contact_sheet.png (of the
    first clips: prior, hands, generated), results.jsonl, config.json and environment.json. Prints
    the path of each clip.
    """

    config: str
    """Name of the model."""
    metadata: Path | None = None
    """CSV or JSONL in EgoSim's columns: ego_prior_video, hand_keypoint_video, first_frame, prompt,
    video_id, and video if the truth is known. Without: a scene of the tabletop world by seed,
    written to OUT/scenes."""
    robot: bool = False
    """The hands of that scene are a robot's gripper."""
    out: Path | None = None
    """Folder to write to; runs/CONFIG_SEED if not given."""
    weights: Path | None = None
    """Folder of weights; without, `tabletop` takes those it ships with and `debug` random ones."""
    lora: Path | None = None
    """LoRA of the video transformer, in PEFT's, diffusers', kohya's or ComfyUI's names."""
    lora_scale: float = 1.0
    """How strongly it counts."""
    video_id: tuple[str, ...] = ()
    """Take these clips alone."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    limit: int | None = None
    """Take at most so many clips; without metadata: so many scenes, of consecutive seeds."""
    start: Annotated[tuple[int, ...], tyro.conf.arg(metavar="FRAME [FRAME ...]")] = (0,)
    """First frame of the window that is generated; several make several clips, {id}_{frame}."""
    steps: int | None = None
    """Denoising steps, if not the model's own."""
    solver: Solver | None = None
    """Sampler, if not the model's own; wan: UniPC with the noise levels and whole timesteps of
    Wan's own sampler; dpmpp_2m: DPM-Solver++ (2M), whose SDE form adds noise at each step."""
    seed: int = 0
    """Each clip's noise comes from this seed and its id; without metadata, the scene does too."""
    batch_size: int | None = None
    """Clips generated together, over all devices: a multiple of mesh.data x mesh.fsdp, which is
    what is taken if none is given."""
    mesh: MeshConfig = field(default_factory=lambda: MeshConfig(data=-1, fsdp=1))
    """Layout of the devices; by default each makes clips of its own. Less time for one clip:
    --mesh.data 1 --mesh.context -1. Weights too large for one device: --mesh.data 1
    --mesh.fsdp -1."""
    lenient: bool = False
    """Repair input as the official loader does: repeat or cut frames, stretch sizes, take a
    missing mask for all observed."""
    decoding: Literal["accurate", "official"] = "accurate"
    """How the colors of videos are decoded; official: as in EgoSim's loader, a gray level
    darker."""
    skip_existing: bool = False
    """Leave clips alone whose video is already there."""
    reconstruct: bool = False
    """Also write {id}_vae.mp4, the truth through the autoencoder: the ceiling of any denoiser."""

    def run(self) -> int:
        """Check everything, compile, generate."""
        check_counts(
            {"--steps": self.steps, "--batch-size": self.batch_size, "--limit": self.limit}
        )
        check_seed(self.seed)
        check_seed(self.seed + (self.limit or 0))
        if min(self.start) < 0:
            raise InputError(f"--start must be at least 0, not {min(self.start)}.")
        if self.lora is not None and self._weights is None:
            raise InputError(f"--lora needs weights: {self.config} has random ones. (--weights)")
        config = self._config()
        mesh, size = self._placing()
        items = None if self.metadata is None else self._items(self.metadata)
        self._open(config)
        if items is None:
            items = self._items(self._make_scenes(config))
        self._check_names(items)
        existing = [item for item in items if self.skip_existing and self._video(item).exists()]
        if existing:
            print(f"{len(existing)} clips are already there", file=sys.stderr)
            self._list(existing)
        there = {item.output_id for item in existing}
        todo = [item for item in items if item.output_id not in there]
        valid, bad = self._check(todo, config)
        for item, problem in bad:
            self._report(item, status="failed", error=problem)
        if valid:
            _warn_of_long_prompts(valid, config)
            bad += self._generate(valid, config, mesh, size)
            self._draw(items, config)
        print(f"{len(todo) - len(bad)} done, {len(bad)} failed: {self._folder}", file=sys.stderr)
        if bad and not valid and not existing:
            return USAGE
        return PARTIAL if bad else DONE

    def _check_names(self, items: Sequence[_Item]) -> None:
        """Raise `InputError` if two clips would write the same file."""
        owners: dict[str, str] = {}
        for item in items:
            for suffix in ("", "_cmp", "_vae"):
                name = f"{item.output_id}{suffix}.mp4"
                other = owners.setdefault(name, item.output_id)
                if other != item.output_id:
                    raise InputError(
                        f"The clips {other} and {item.output_id} would both write {name}. Rename "
                        "one of them. (column video_id)"
                    )

    def _list(self, items: Sequence[_Item]) -> None:
        """Report clips whose video is there and whose line a kill prevented."""
        path = self._folder / RESULTS
        lines = read_lines(path) if path.exists() else ()
        done = {
            line.get("video_id")
            for _, line in lines
            if isinstance(line, dict) and line.get("status") == "done"
        }
        for item in items:
            if item.output_id not in done:
                self._report(item, status="done", seed=_seed(self.seed, item.output_id))

    def _make_scenes(self, config: ModelConfig) -> Path:
        """Scenes of the tabletop world at the model's size, as files; their metadata."""
        from egosim_jax.data.clips import write_clips
        from egosim_jax.worlds.tabletop import make_sequence, to_triplet

        seeds = range(self.seed, self.seed + (self.limit or 1))
        kind = "robot" if self.robot else "human"
        clips = (next(make_sequence(seed, spec=config.video, kind=kind)) for seed in seeds)
        triplets = (to_triplet(clip) for clip in clips)
        return write_clips(self._folder / "scenes", triplets, fps=config.video.fps)

    def _items(self, metadata: Path) -> list[_Item]:
        from egosim_jax.data.metadata import read_metadata, select

        chosen = select(
            read_metadata(metadata),
            where=self.where,
            video_ids=self.video_id,
            limit=self.limit,
        )
        several = len(self.start) > 1
        return [
            _Item(files, start, f"{files.video_id}_{start}" if several else files.video_id)
            for files, start in itertools.product(chosen, self.start)
        ]

    def _config(self) -> ModelConfig:
        import dataclasses

        from egosim_jax import configs
        from egosim_jax.diffusion import DDIM, DPMSolver, Euler, RectifiedFlow, UniPC

        config = configs.get(self.config)
        if self._weights is not None:
            config = config.at(self._weights)
        elif config.name != "debug":
            raise InputError(f"{config.name} needs weights. (--weights FOLDER)")
        config = dataclasses.replace(config, steps=self.steps or config.steps)
        if self.solver is not None:
            solvers = {
                "euler": Euler(),
                "unipc": UniPC(),
                "wan": UniPC(),
                "ddim": DDIM(),
                "dpmpp_2m": DPMSolver(),
                "dpmpp_2m_sde": DPMSolver(stochastic=True),
            }
            config = dataclasses.replace(config, solver=solvers[self.solver])
        if self.solver == "wan":
            if not isinstance(config.process, RectifiedFlow):
                raise InputError(f"{config.name} is not a rectified flow. (--solver wan)")
            process = RectifiedFlow.wan_unipc(config.process.shift)
            config = dataclasses.replace(config, process=process)
        return config

    def _placing(self) -> tuple[Mesh, int]:
        """The devices, and how many clips they make together."""
        from egosim_jax.sharding import check_batch, make_mesh, parts

        mesh = make_mesh(self.mesh)
        size = parts("batch", mesh) if self.batch_size is None else self.batch_size
        check_batch(size, mesh)
        return mesh, size

    def _open(self, config: ModelConfig) -> None:
        from egosim_jax.io.digest import sha256
        from egosim_jax.io.run import open_folder
        from egosim_jax.io.weights import hashes

        digests = None if self._weights is None else hashes(self._weights)
        if self.lora is not None and digests is not None:
            from egosim_jax.convert.lora import check_base

            check_base(self.lora, [digests["dit"]])
        run = {
            "model": config,
            "weights": digests,
            "lora": None if self.lora is None else [sha256(self.lora), self.lora_scale],
            "seed": self.seed,
            "policy": self._policy,
        }
        if self.decoding != "accurate":
            run["decoding"] = self.decoding
        open_folder(self._folder, run)
        for name, digest in (digests or {}).items():
            print(f"{config.name}: {name} sha256 {digest[:16]}", file=sys.stderr)

    def _check(
        self, items: Sequence[_Item], config: ModelConfig
    ) -> tuple[list[_Item], list[tuple[_Item, str]]]:
        """The items that can be read, and the others with what is wrong; nothing is compiled."""
        from egosim_jax.data.clips import check_clip
        from egosim_jax.data.metadata import check_presence

        if items:
            check_presence([item.files for item in items])
        sound, bad = [], []
        for item in items:
            problems = check_clip(item.files, config.video, start=item.start, policy=self._policy)
            if problems:
                bad.append((item, listing(problems)))
            else:
                sound.append(item)
        return sound, bad

    def _generate(
        self, items: Sequence[_Item], config: ModelConfig, mesh: Mesh, size: int
    ) -> list[tuple[_Item, str]]:
        """Generate `size` clips after `size` clips; the items that failed."""
        from egosim_jax.generator import batches
        from egosim_jax.sharding import parts

        unit = parts("batch", mesh)
        size = min(size, -(-len(items) // unit) * unit)  # what the mesh divides and is enough
        then = time.monotonic()
        generator = self._generator(config, mesh)
        read = time.monotonic()
        generator.compile(size)
        print(
            f"weights in {read - then:.1f} s, programs in {time.monotonic() - read:.1f} s",
            file=sys.stderr,
        )

        bad: list[tuple[_Item, str]] = []
        began, done = time.monotonic(), 0
        for batch in batches(items, size):
            then = time.monotonic()
            loaded, problems = self._load(batch, config)
            bad += problems
            if loaded:
                bad += self._batch(generator, loaded, size)
            done += len(batch)
            left = (time.monotonic() - began) / done * (len(items) - done)
            print(
                f"{done}/{len(items)} clips, {time.monotonic() - then:.1f} s, {left:.0f} s left",
                file=sys.stderr,
            )
        return bad

    def _generator(self, config: ModelConfig, mesh: Mesh) -> Generator:
        from egosim_jax.generator import Generator
        from egosim_jax.networks import Networks

        if self._weights is None:
            print(f"{config.name}: random weights of seed {self.seed}", file=sys.stderr)
            return Generator(config, Networks.random(config, seed=self.seed), mesh)
        return Generator.load(
            config, self._weights, mesh=mesh, lora=self.lora, lora_scale=self.lora_scale
        )

    def _load(
        self, batch: Sequence[_Item], config: ModelConfig
    ) -> tuple[list[tuple[_Item, Triplet]], list[tuple[_Item, str]]]:
        from egosim_jax.data.clips import load_triplet

        loaded, bad = [], []
        for item in batch:
            try:
                triplet = load_triplet(
                    item.files,
                    config.video,
                    start=item.start,
                    policy=self._policy,
                    decoding=self.decoding,
                )
                loaded.append((item, triplet))
            except InputError as error:
                bad.append((item, str(error)))
                self._report(item, status="failed", error=str(error))
        return loaded, bad

    def _batch(
        self, generator: Generator, loaded: Sequence[tuple[_Item, Triplet]], size: int
    ) -> list[tuple[_Item, str]]:
        """Generate and write one batch, filled up to `size` so that nothing compiles again."""
        items, triplets = zip(*loaded, strict=True)
        fill = size - len(items)
        triplets = [*triplets, *[triplets[-1]] * fill]
        seeds = [_seed(self.seed, item.output_id) for item in (*items, *[items[-1]] * fill)]
        then = time.monotonic()
        try:
            clips = generator.generate(triplets, seeds)
        except FloatingPointError as error:
            for item in items:
                self._report(item, status="failed", error=str(error))
            return [(item, str(error)) for item in items]
        seconds = (time.monotonic() - then) / len(items)
        ceilings = generator.reconstruct(triplets) if self.reconstruct else [None] * size
        for item, triplet, clip, ceiling, seed in zip(
            items, triplets, clips, ceilings, seeds, strict=False
        ):
            self._write(item, triplet, clip, ceiling)
            self._report(item, status="done", seed=seed, seconds=round(seconds, 3))
            print(self._video(item))
        return []

    def _write(self, item: _Item, triplet: Triplet, clip: Clip, ceiling: Clip | None) -> None:
        import numpy as np

        from egosim_jax.io.video import write_video

        shown = [triplet.prior, triplet.hands, clip.frames]
        if triplet.target is not None:
            shown.append(triplet.target)
        comparison = np.concatenate(shown, axis=2)
        write_video(self._folder / f"{item.output_id}_cmp.mp4", comparison, clip.fps)
        if ceiling is not None:
            write_video(self._folder / f"{item.output_id}_vae.mp4", ceiling.frames, clip.fps)
        write_video(self._video(item), clip.frames, clip.fps)

    def _report(self, item: _Item, *, status: str, **values: Any) -> None:
        """Append a line to results.jsonl; an id's last line counts."""
        if status == "failed":
            print(f"failed: {item.output_id}: {values['error']}", file=sys.stderr)
        own = {
            "video_id": item.output_id,
            "source_id": item.files.video_id,
            "start": item.start,
            "status": status,
            "output": f"{item.output_id}.mp4",
            **values,
            "prompt": item.files.prompt,
        }
        # A column of the metadata never takes the place of what happened.
        reserved = {*own, "seed", "seconds", "error"}
        extra = item.files.extra.items()
        line = own | {f"metadata_{k}" if k in reserved else k: text for k, text in extra}
        append_line(self._folder / RESULTS, line)

    def _video(self, item: _Item) -> Path:
        return self._folder / f"{item.output_id}.mp4"

    def _draw(self, items: Sequence[_Item], config: ModelConfig) -> None:
        """The contact sheet of the first clips that are there."""
        import numpy as np

        from egosim_jax.io.video import read_video

        blocks = []
        for item in [item for item in items if self._video(item).exists()][:SHEET_CLIPS]:
            panels = read_video(self._folder / f"{item.output_id}_cmp.mp4").frames
            panels = np.split(panels, panels.shape[2] // config.video.width, axis=2)
            blocks.append(SheetClip(f"{item.output_id}   prior, hands, generated", panels[:3]))
        if blocks:
            moments = np.linspace(0, config.video.frames - 1, SHEET_COLUMNS).round().astype(int)
            sheet = self._folder / "contact_sheet.png"
            draw_sheet(blocks, sheet, moments=moments.tolist(), width=SHEET_WIDTH)
            print(sheet)

    @property
    def _folder(self) -> Path:
        return self.out or Path("runs") / f"{self.config}_{self.seed}"

    @property
    def _weights(self) -> Path | None:
        from egosim_jax import configs

        return self.weights or configs.shipped_weights(self.config)

    @property
    def _policy(self) -> Any:
        return "lenient" if self.lenient else "strict"


@dataclass(frozen=True)
class _Item:
    """A window of a clip."""

    files: ClipFiles
    start: int
    output_id: str


def _warn_of_long_prompts(items: Sequence[_Item], config: ModelConfig) -> None:
    prompts = {item.files.video_id: item.files.prompt for item in items}
    tokens = config.tokenizer.tokenize(list(prompts.values()))
    if tokens.cut:
        most = config.tokenizer.max_tokens
        print(
            f"warning: {tokens.cut} of {len(prompts)} prompts are longer than {most} tokens (the "
            f"longest has {max(tokens.lengths)}) and are cut",
            file=sys.stderr,
        )


def _seed(seed: int, name: str) -> int:
    """A seed of its own for each clip, so that its noise depends on neither order nor batch."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:4], "big")
