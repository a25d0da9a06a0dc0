"""Conversion at full size: memory of the 14B, and speed of a 1.3B versus reading alone.

    python -m tests.benchmarks.bench_convert memory --folder FOLDER
    python -m tests.benchmarks.bench_convert speed --folder FOLDER [--rounds 3]

`memory` makes the EgoSim-14B release in its names, shapes, dtypes and files, all of it holes that
take no room, converts it by the command and watches the anonymous memory of the process (RssAnon:
what it holds beyond mapped files). `speed` makes a 1.3B video transformer of random bfloat16 values
and converts it in turn with reading the same file by safetensors and with copying it, each time
with the file dropped from the disk's cache. Where the disk writes slower than it reads, nothing
that writes comes near reading: a target in memory (--target /dev/shm/out) leaves that out. The
seconds of a conversion count from when it has checked all names and begins to write.
The folder needs 48 GB of room for the first, 8 GB for the second.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from safetensors import safe_open
from safetensors.torch import save_file

from egosim_jax import configs
from egosim_jax.convert.plan import to_torch
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io.mapped import Tensor, read_safetensors

DTYPES = {
    "dit": torch.bfloat16, "vae": torch.float32, "text": torch.bfloat16, "image": torch.float16,
}  # fmt: skip
"""Dtypes of the released files."""
MAX_GB, RATIO = 4.0, 0.8
"""Goals: anonymous memory, and speed as a share of reading's."""
POLL_S = 0.02
SEED = 0


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Convert the whole 14B release and find the peak of anonymous memory."""

    folder: Path
    """Folder to make and convert it in; both are removed again."""

    def run(self) -> None:
        """Make, convert, watch, print."""
        source, out = self.folder / "EgoSim-14B", self.folder / "converted"
        source.mkdir(parents=True)
        try:
            files = [make_holes(source, network) for network in DTYPES]
            total = sum(file.stat().st_size for file in files) / 1e9
            taken = sum(512 * file.stat().st_blocks for file in files) / 1e9
            print(f"{total:.1f} GB of files that take {taken:.2f} GB")
            seconds, peak = convert(source, "egosim_14b", out)
            for network in DTYPES:
                converted = read_safetensors(out / f"{network}.safetensors")
                assert {p: t.shape for p, t in converted.items()} == ours("egosim_14b", network)
        finally:
            shutil.rmtree(source)
            shutil.rmtree(out, ignore_errors=True)
        print(f"converted in {seconds:.0f} s, {total / seconds:.2f} GB/s")
        verdict = "met" if peak < MAX_GB else "MISSED"
        print(f"peak RssAnon {peak:.2f} GB; goal below {MAX_GB:.0f}: {verdict}")


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Convert a 1.3B model of random values and read it, in turn."""

    folder: Path
    """Folder to make it in; it is removed again."""
    target: Path | None = None
    """Folder to convert and copy to; by default one in `folder`."""
    rounds: int = 3
    """Number of rounds."""

    def run(self) -> None:
        """Make, convert and read, print."""
        source, out = self.folder / "random", self.target or self.folder / "converted"
        source.mkdir(parents=True)
        times: dict[str, list[float]] = {"convert": [], "read": [], "copy": []}
        peaks = []
        try:
            file = make_random(source)
            size = file.stat().st_size / 1e9
            for _ in range(self.rounds):
                forget(file)
                seconds, peak = convert(source, "egosim_1_3b", out)
                times["convert"].append(seconds)
                peaks.append(peak)
                shutil.rmtree(out)
                forget(file)
                times["read"].append(read(file))
                forget(file)
                times["copy"].append(copy(file, out))
        finally:
            shutil.rmtree(source)
            shutil.rmtree(out, ignore_errors=True)
        for name, found in times.items():
            rates = [size / seconds for seconds in found]
            print(f"{name:8s} {median(rates):.2f} GB/s [{min(rates):.2f}, {max(rates):.2f}]")
        print(f"{size:.2f} GB, peak RssAnon {max(peaks):.2f} GB")
        for name, doing in {"read": "reading", "copy": "copying"}.items():
            ratio = median(r / c for r, c in zip(times[name], times["convert"], strict=True))
            verdict = "met" if ratio >= RATIO else "MISSED"
            print(f"converting / {doing}: {ratio:.2f}; goal {RATIO}: {verdict}")


def ours(config: str, network: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a network's weights by path."""
    return weight_shapes(configs.get(config).networks[network])


def theirs(config: str, network: str) -> dict[str, tuple[int, ...]]:
    """The names and shapes of the released file."""
    outlines = {
        path: Tensor(
            shape=shape, dtype=np.dtype(np.uint8), data=memoryview(b""), strides=(0,) * len(shape)
        )
        for path, shape in ours(config, network).items()
    }
    weights = to_torch(outlines, configs.get(config).networks[network], "wan")
    return {weight.name: weight.shape for weight in weights}


def make_holes(folder: Path, network: str) -> Path:
    """A released file whose values are all 0, and not there."""
    shapes, dtype = theirs("egosim_14b", network), DTYPES[network]
    table = table_of(configs.get("egosim_14b").networks[network])
    stem = folder / table.namings["wan"].stem
    if network == "dit":
        return write_holes(stem.with_suffix(".safetensors"), shapes)
    file = Path(f"{stem}.pth")
    wide = {torch.float32: np.int32}.get(dtype, np.int16)
    # NumPy's zeros are pages that nobody has touched.
    tensors = {n: torch.from_numpy(np.zeros(s, wide)).view(dtype) for n, s in shapes.items()}
    with Holes(file, "w") as target:
        torch.save(tensors, target)
    return file


class Holes(io.FileIO):
    """File that leaves holes instead of writing zeros."""

    def write(self, data: Any) -> int:
        """Write the data, or skip as many bytes of zeros."""
        view = np.frombuffer(data, np.uint8)
        if len(view) < 4096 or view.any():
            return super().write(data)
        self.truncate(self.seek(len(view), io.SEEK_CUR))
        return len(view)


def write_holes(file: Path, shapes: Mapping[str, tuple[int, ...]]) -> Path:
    """A safetensors file of bfloat16 with a header alone."""
    header, end = {}, 0
    for name, shape in shapes.items():
        begin, end = end, end + 2 * math.prod(shape)
        header[name] = {"dtype": "BF16", "shape": shape, "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    with file.open("wb") as target:
        target.write(len(text).to_bytes(8, "little") + text)
        target.truncate(8 + len(text) + end)
    return file


def make_random(folder: Path) -> Path:
    """A 1.3B video transformer in the released names."""
    generator = torch.Generator().manual_seed(SEED)
    file = folder / "diffusion_pytorch_model.safetensors"
    tensors = {
        name: torch.randn(shape, generator=generator).to(torch.bfloat16)
        for name, shape in theirs("egosim_1_3b", "dit").items()
    }
    save_file(tensors, file)
    return file


def convert(source: Path, config: str, out: Path) -> tuple[float, float]:
    """Run the command; its seconds of writing and its peak of anonymous memory in GB."""
    args = ["weights", str(source), "--config", config, "--out", str(out)]
    then, peak = None, 0
    process = subprocess.Popen([sys.executable, "-m", "egosim_jax.convert", *args])
    while process.poll() is None:
        if then is None and out.exists():
            then = time.perf_counter()
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
        lines = [line for line in status.splitlines() if line.startswith("RssAnon:")]
        peak = max([peak, *(1024 * int(line.split()[1]) for line in lines)])
        time.sleep(POLL_S)
    assert process.returncode == 0
    assert then is not None
    return time.perf_counter() - then, peak / 1e9


def read(file: Path) -> float:
    """Seconds in which safetensors alone reads every tensor."""
    then = time.perf_counter()
    with safe_open(file, framework="pt") as opened:
        for name in opened.keys():  # noqa: SIM118 (it is no mapping)
            opened.get_tensor(name).clone()
    return time.perf_counter() - then


def copy(file: Path, out: Path) -> float:
    """Seconds in which the file is copied and written out."""
    out.mkdir()
    target = out / file.name
    then = time.perf_counter()
    shutil.copyfile(file, target)
    with target.open("rb") as opened:
        os.fsync(opened.fileno())
    seconds = time.perf_counter() - then
    shutil.rmtree(out)
    return seconds


def forget(file: Path) -> None:
    """Write a file out and drop it from the cache."""
    with file.open("rb") as opened:
        os.fsync(opened.fileno())
        os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


if __name__ == "__main__":
    command = Annotated[Memory, tyro.conf.subcommand("memory")]
    other = Annotated[Speed, tyro.conf.subcommand("speed")]
    tyro.cli(command | other).run()
