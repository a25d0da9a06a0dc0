"""Our loader versus torch's, over the same shards, and how long training waits for it.

Samples a second, in batches of 8, of two kinds of shards:

    videos    mp4 files; a window of 17 frames of 160 x 96 is decoded: target, prior, hands, mask,
              and the first frame
    latents   arrays that are read as they are, a training step's input

Theirs is a `DataLoader` over the same reader with the same transform, and with as many worker
processes. Without any, ours prepares examples in four threads, ahead of the caller; theirs in the
caller's own, when asked. The loaders take turns, so that a busy neighbor slows both, and each
round gives one ratio, ours to theirs. What a loader had prepared while the other's turn lasted is
thrown away first.

Then a model is trained on the latents, as the trainer does it: the next batch is asked for while
the devices are at work. It is also trained one epoch each on latents in several places, which take
turns; opening and copying them counts. The ratios are to the local shards of the same round.

    shared folder    no file is in the page cache, and each record is read 5 ms late, as by NFS
    object store     a local server of S3's protocol, without a copy, and with one of before

Without folders, small ones are made: of clips of the tabletop world, and of random latents, since
what they hold does not change how they are read.

    python -m tests.benchmarks.bench_loader [--videos FOLDER] [--latents FOLDER]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory, mkdtemp
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tyro

from egosim_jax.data.loader import make_loader
from egosim_jax.data.records import Record
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.stores import local_shards
from egosim_jax.data.transforms import DecodeWindow

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig

BATCH = 8
CLIPS, LATENTS = 16, 256
"""Records that are made, if no folders are given."""
LATENCY_S = 0.005
"""Wait before each read of a shared folder, in seconds."""
GOAL = 0.01
"""Share of a training step that may be spent waiting for data."""


class Prepared(NamedTuple):
    """Loaders over one folder, ours and theirs, as endless iterators of batches."""

    ours: Iterator[Any]
    theirs: Iterator[Any]


def main(
    videos: Path | None = None,
    latents: Path | None = None,
    seconds: float = 2.0,
    rounds: int = 5,
    workers: tuple[int, ...] = (0, 2),
    steps: int = 30,
    model: str = "tabletop",
    only_places: bool = False,
) -> None:
    """Time both loaders, then training.

    Args:
        videos: Folder of shards of videos, at least 17 frames long; made if not given.
        latents: Folder of shards of latents of the model `tabletop`; made if not given.
        seconds: How long a loader's turn lasts.
        rounds: Turns of each.
        workers: Numbers of worker processes to try; 0 for none.
        steps: Training steps.
        model: Config of the model to train.
        only_places: Only compare the places of latents.
    """
    if min(seconds, rounds, steps) <= 0:
        raise SystemExit("--seconds, --rounds and --steps must be positive.")
    from egosim_jax import configs

    config = configs.get(model)
    with TemporaryDirectory() as folder:
        if only_places:
            compare_places(config, latents or make_latents(config, Path(folder)), rounds)
            return
        sources = {
            "videos": ShardReader(videos or make_videos(config, Path(folder))),
            "latents": ShardReader(latents or make_latents(config, Path(folder))),
        }
        decode = {"videos": DecodeWindow(config.video), "latents": None}
        for name, source in sources.items():
            for count in workers:
                compare(f"{name}, {count} workers", source, decode[name], count, seconds, rounds)
        report_waiting(config, sources["latents"], steps)
        compare_places(config, sources["latents"].folder, rounds)


def compare(
    name: str,
    source: ShardReader,
    transform: DecodeWindow | None,
    workers: int,
    seconds: float,
    rounds: int,
) -> None:
    """Let both loaders take turns, and print samples a second and their ratio."""
    ours = make_loader(source, batch_size=BATCH, seed=0, workers=workers, transform=transform)
    with closing(ours):
        loaders = Prepared(ours, iter(their_loader(source, transform, workers)))
        ready = 2 * workers + 2  # batches that either may hold
        speeds = []
        for turn in range(rounds):
            order = reversed(loaders) if turn % 2 else loaders
            found = [samples_per_second(loader, seconds, ready) for loader in order]
            speeds.append(found[::-1] if turn % 2 else found)
    ratios = [ours / theirs for ours, theirs in speeds]
    print(
        f"{name}: ours {median(ours for ours, _ in speeds):.1f} samples/s, "
        f"torch {median(theirs for _, theirs in speeds):.1f}, "
        f"ratio {median(ratios):.2f} [{min(ratios):.2f}, {max(ratios):.2f}] ({rounds} rounds)",
        flush=True,
    )


def samples_per_second(batches: Iterator[Any], seconds: float, ready: int) -> float:
    """Speed over the first whole batches that last so long, after those that were ready."""
    for _ in range(ready):
        next(batches)
    start, samples = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - start) < seconds:
        next(batches)
        samples += BATCH
    return samples / elapsed


@dataclass(frozen=True)
class TheirDataset:
    """Records of a folder for torch's `DataLoader`."""

    source: ShardReader
    transform: DecodeWindow | None

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Any:
        arrays = self.source[index].arrays
        if self.transform is None:
            return arrays
        return self.transform.random_map(arrays, np.random.default_rng())


def their_loader(source: ShardReader, transform: DecodeWindow | None, workers: int) -> Any:
    """torch's loader, endless; its workers are spawned, since a forked jax may hang."""
    from torch.utils.data import DataLoader, RandomSampler

    dataset = TheirDataset(source, transform)
    return DataLoader(
        dataset,
        batch_size=BATCH,
        sampler=RandomSampler(dataset, replacement=True, num_samples=2**40),
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        collate_fn=stacked,
    )


def stacked(examples: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """A batch of tensors, which torch's workers share instead of copying."""
    import torch

    return {
        name: torch.from_numpy(np.stack([example[name] for example in examples]))
        for name in examples[0]
    }


def make_trainer(config: ModelConfig) -> Callable[[Iterator[Any], int], tuple[float, float]]:
    """Return a function that trains some steps; it returns the seconds, in all and waiting."""
    import jax
    from flax import nnx

    from egosim_jax.train.config import OptimizerConfig, TrainConfig
    from egosim_jax.train.tasks.denoising import Denoising
    from egosim_jax.train.update import TrainState, make_update

    task = Denoising(model=config)
    graph, params, frozen = nnx.split(task.networks(nnx.Rngs(0)), task.trained, ...)
    training = TrainConfig(steps=1, optimizer=OptimizerConfig(name="muon"))
    update = jax.jit(make_update(task, graph, training), donate_argnums=0)
    state = TrainState.create(params, training.optimizer)

    def train(batches: Iterator[Any], steps: int) -> tuple[float, float]:
        nonlocal state
        start, waited, before = time.perf_counter(), 0.0, None
        for _ in range(steps):
            asked = time.perf_counter()
            examples = next(batches)
            waited += time.perf_counter() - asked
            state, metrics = update(state, frozen, jax.device_put(examples))
            jax.block_until_ready(before)
            before = metrics
        jax.block_until_ready(state)
        return time.perf_counter() - start, waited

    return train


def report_waiting(config: ModelConfig, source: ShardReader, steps: int) -> None:
    """Train, and print which share of the time went into waiting for batches."""
    train = make_trainer(config)
    with closing(make_loader(source, batch_size=BATCH, seed=0)) as batches:
        train(batches, 1)
        total, waited = train(batches, steps)
    print(
        f"training: {waited / total:.3%} of {steps} steps of {total / steps:.2f} s waiting for "
        f"data ({1000 * waited / steps:.2f} ms a step); "
        f"goal below {GOAL:.0%}: {'met' if waited < GOAL * total else 'MISSED'}"
    )


class SharedFolder(ShardReader):
    """A folder as on a file server: nothing is in memory, and every read waits for the network."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        for shard in self.manifest.shards:
            with (folder / shard.file).open("rb") as file:
                os.fsync(file.fileno())
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

    def __getitem__(self, index: int) -> Record:
        time.sleep(LATENCY_S)
        return super().__getitem__(index)


def compare_places(config: ModelConfig, latents: Path, rounds: int) -> None:
    """Train an epoch on latents in each place, in turns, and print the ratios of the speeds."""
    train = make_trainer(config)
    with closing(make_loader(ShardReader(latents), batch_size=BATCH, seed=0)) as batches:
        train(batches, 1)
    with store_of(latents) as address, TemporaryDirectory() as cache:
        places: dict[str, Callable[[], ShardReader]] = {
            "local shards": lambda: ShardReader(latents),
            "shared folder": lambda: SharedFolder(latents),
            "object store, first epoch": lambda: ShardReader(
                local_shards(address, cache=Path(mkdtemp(dir=cache)))
            ),
            "object store, copied before": lambda: ShardReader(
                local_shards(address, cache=Path(cache, "kept"))
            ),
        }
        places["object store, copied before"]()
        speeds: dict[str, list[float]] = {name: [] for name in places}
        for turn in range(rounds):
            for name in list(places)[:: -1 if turn % 2 else 1]:
                start = time.perf_counter()
                source = places[name]()
                with closing(make_loader(source, batch_size=BATCH, seed=turn)) as batches:
                    train(batches, len(source) // BATCH)
                speeds[name].append(len(source) / (time.perf_counter() - start))
    size = sum(shard.size for shard in ShardReader(latents).manifest.shards)
    print(f"an epoch of {size / 1e6:.0f} MB of latents, training {config.name}:")
    for name, found in speeds.items():
        ratios = [own / local for own, local in zip(found, speeds["local shards"], strict=True)]
        print(
            f"  {name}: {median(found):.1f} samples/s, ratio {median(ratios):.3f} "
            f"[{min(ratios):.3f}, {max(ratios):.3f}] ({rounds} rounds)",
            flush=True,
        )


@contextmanager
def store_of(folder: Path) -> Iterator[str]:
    """Serve a folder as an object store on this machine; its address."""
    from moto.server import ThreadedMotoServer
    from s3fs import S3FileSystem

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    os.environ |= {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "id",
        "AWS_SECRET_ACCESS_KEY": "key",
    }
    files = S3FileSystem(skip_instance_cache=True)
    files.mkdir("bucket")
    files.put(f"{folder}/", "bucket/latents/", recursive=True)
    yield "s3://bucket/latents"
    server.stop()


def make_videos(config: ModelConfig, folder: Path) -> Path:
    """Shards of clips of the tabletop world as mp4, two windows long."""
    from egosim_jax.data.clips import write_clips
    from egosim_jax.data.metadata import read_metadata
    from egosim_jax.data.pack import pack
    from egosim_jax.worlds.tabletop import make_sequence, to_triplet

    spec = replace(config.video, frames=2 * config.video.frames - 1)
    clips = (next(make_sequence(seed, spec=spec)) for seed in range(CLIPS))
    table = write_clips(folder / "clips", (to_triplet(clip) for clip in clips), fps=spec.fps)
    out = folder / "videos"
    for problem in pack(read_metadata(table), out=out, spec=None, provenance={}):
        if problem:
            raise SystemExit(problem)
    return out


def make_latents(config: ModelConfig, folder: Path) -> Path:
    """Shards of random latents and encoders' inputs."""
    rng = np.random.default_rng(0)
    shape, tokens = config.latent_shape, config.tokenizer.max_tokens
    size = config.image.image_size
    out = folder / "latents"
    with ShardWriter(out, kind="latents", spec=config.video) as writer:
        for number in range(LATENTS):
            videos = {
                name: rng.standard_normal((*shape, config.vae.z_dim), np.float32)
                for name in ("target", "prior", "hands")
            }
            others = {
                "mask": rng.integers(0, 2, (*shape, 4), np.uint8),
                "ids": rng.integers(0, config.text.vocab, tokens, np.int32),
                "ids_mask": np.arange(tokens) < rng.integers(1, tokens),
                "pixels": rng.standard_normal((size, size, 3), np.float32),
            }
            writer.add({**videos, **others}, {"video_id": str(number), "prompt": "", "extra": {}})
    return out


if __name__ == "__main__":
    tyro.cli(main)
