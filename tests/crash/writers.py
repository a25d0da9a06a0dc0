"""Everything that writes: what it writes, and how that is read back.

A writer is run twice, in its own folder: for version 0, which makes what was complete before,
and for version 1, which is killed. One that always makes the same starts from nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np
import open3d  # noqa: F401 - imported once, it is not imported in every fork
from jax.sharding import SingleDeviceSharding
from PIL import Image
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.configs.model import Networks
from egosim_jax.convert.__main__ import main as egosim_convert
from egosim_jax.data.clips import write_clips
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.io import executables, weights
from egosim_jax.io.atomic import append_line
from egosim_jax.io.bounded import read_lines
from egosim_jax.io.checkpoint import Checkpoints
from egosim_jax.io.journal import Journal
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.io.run import open_folder
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.rendering.portrait import write_portrait
from egosim_jax.state import snapshot
from egosim_jax.train import encode
from egosim_jax.types import SceneState, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import dataset

SPEC = VideoSpec(frames=9, height=64, width=96)
Read = Mapping[str, str]
"""Digests of the files that are there, by name."""


@dataclass(frozen=True)
class Writer:
    """A kind of file or folder that is written, below a folder `place`."""

    write: Callable[[Path, Path, int], object]
    """Given the place, the folder of inputs and the version."""
    read: Callable[[Path], Read]
    """Raises if the files are neither complete nor absent."""
    before: bool = True
    """True if there is a version 0."""
    same_bytes: bool = True
    """True if two runs write the same files; else only the contents read are compared."""


def inputs(folder: Path) -> None:
    """Make what the writers are given."""
    networks = Networks.abstract(configs.get("debug")).parts()
    for name, part in networks.items():
        rng = np.random.default_rng(0)
        tensors = {
            path: 0.02 * rng.normal(size=shape).astype(np.float32)
            for path, shape in weights.flat_shapes(part).items()
        }
        weights.write(folder / "weights" / f"{name}.safetensors", tensors)
    for version, dtype in enumerate(("float16", "float32")):
        out = f"--out {folder}/torch{version} --dtype {dtype}"
        _run(egosim_convert, f"to-torch {folder}/weights --config debug {out}")
        _write_lora(folder / f"lora{version}.safetensors", version)
    for version, names in enumerate(("ab", "cd")):
        triplets = [_triplet(name) for name in names]
        write_clips(folder / f"clips{version}", triplets, fps=16)
        with ShardWriter(folder / f"frames{version}", kind="frames", spec=SPEC) as writer:
            for triplet in triplets:
                about = {"video_id": triplet.video_id, "prompt": "", "extra": {}}
                names_of = ("prior", "hands", "mask", "first_frame", "target")
                writer.add({name: getattr(triplet, name) for name in names_of}, about)


def _write_lora(path: Path, version: int) -> None:
    rng, dim = np.random.default_rng(version), configs.get("debug").dit.dim
    tensors = {}
    for name in ("self_attn.q", "self_attn.v"):
        stem = f"diffusion_model.blocks.0.{name}"
        tensors[f"{stem}.lora_A.weight"] = rng.normal(size=(2, dim)).astype(np.float32)
        tensors[f"{stem}.lora_B.weight"] = rng.normal(size=(dim, 2)).astype(np.float32)
    save_file(tensors, path)  # in names of others


def _triplet(name: str) -> Triplet:
    rng = np.random.default_rng(ord(name))
    shape = (SPEC.frames, SPEC.height, SPEC.width)
    prior, hands, truth = rng.integers(0, 256, (3, *shape, 3), np.uint8)
    first = truth[0].copy()
    mask = np.zeros(shape, np.uint8)
    mask[:, :32] = 255
    return Triplet(
        video_id=name, prompt="take", prior=prior, hands=hands, mask=mask, first_frame=first,
        target=truth,
    )  # fmt: skip


def state(version: int) -> SceneState:
    rng = np.random.default_rng(version)
    return SceneState(
        points_m=rng.normal(size=(500, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (500, 3), np.uint8),
        object_ids=np.zeros(500, np.int32),
        last_seen=np.zeros(500, np.int32),
        intrinsics_px=np.eye(3),
        step=version,
    )


def _run(main: Callable[..., int], arguments: str) -> None:
    with Path(os.devnull).open("w") as quiet, redirect_stdout(quiet), redirect_stderr(quiet):
        code = main(arguments.split())
    assert code == 0, f"{arguments} ended with {code}"


def _frames(version: int) -> np.ndarray:
    return np.random.default_rng(version).integers(0, 256, (3, 32, 32, 3), np.uint8)


def _sha256(data: bytes | np.ndarray) -> str:
    return hashlib.sha256(data if isinstance(data, bytes) else data.tobytes()).hexdigest()


def _file(name: str, read: Callable[[Path], Any]) -> Callable[[Path], Read]:
    """Read one file."""
    return lambda place: {name: read(place / name)} if os.path.lexists(place / name) else {}


def _shards(place: Path) -> Read:
    if not (place / "shards" / MANIFEST).exists():
        return {}
    records = [
        [json.dumps(dict(r.metadata)), *(_sha256(a) for _, a in sorted(r.arrays.items()))]
        for r in ShardReader(place / "shards")
    ]
    return {"shards": _sha256(json.dumps(records).encode())}


def _weights(place: Path) -> Read:
    files = [path for path in (place / "out").glob("*.safetensors") if path.name[0] != "."]
    return {path.name: _tensors(path) for path in files}


def _tensors(path: Path) -> str:
    tensors = sorted(read_safetensors(path).items())
    return _sha256(b"".join(name.encode() + t.array().tobytes() for name, t in tensors))


def _lines(path: Path, name: str) -> Read:
    lines = read_lines(path, limit=1 << 20) if path.exists() else []
    return {line[name]: json.dumps(line) for _, line in lines}


def _append_results(place: Path, inputs: Path, version: int) -> None:
    path = place / "results.jsonl"
    done = _lines(path, "video_id")
    for number in range(3 * (version + 1)):
        if f"clip_{number}" not in done:
            append_line(path, {"video_id": f"clip_{number}", "prompt": "take " * 10})


def _journal(place: Path, inputs: Path, version: int) -> None:
    time.monotonic = float  # the line says how long a phase took
    journal = Journal(place)
    for number in range(2 * (version + 1)):
        journal.require(f"{number} action", {"action": str(number)})
        journal.phase(
            f"{number} fuse",
            place / f"clip_{number}" / "state",
            make=lambda number=number: state(number),
            save=snapshot.save,
            load=snapshot.load,
        )


def _config(place: Path, inputs: Path, version: int) -> None:
    mutable = ["version"]
    open_folder(place / "run", {"version": version, "clips": 3}, mutable=mutable)


def _read_config(place: Path) -> Read:
    files = [path for path in (place / "run").glob("*.json") if path.name[0] != "."]
    return {path.name: json.dumps(json.loads(path.read_text("utf-8"))) for path in files}


def _checkpoint(place: Path, inputs: Path, version: int) -> None:
    checkpoints = Checkpoints(place / "checkpoints")
    for step in ((1, 2), (3,))[version]:
        if step not in checkpoints.steps:
            tree = {"weights": np.arange(6.0) + step, "step": np.int32(step)}
            data = _numbers()
            for _ in range(step):
                next(data)
            checkpoints.save(step, jax.tree.map(jnp.asarray, tree), data)
    checkpoints.close()


def _numbers() -> grain.DatasetIterator:
    return iter(grain.MapDataset.range(100).shuffle(seed=1).repeat().to_iter_dataset())


def _read_checkpoints(place: Path) -> Read:
    """The newest alone: which older ones stay is Orbax's to choose."""
    checkpoints = Checkpoints(place / "checkpoints")
    sharding = SingleDeviceSharding(jax.devices()[0])
    abstract = {
        "weights": jax.ShapeDtypeStruct((6,), np.float32, sharding=sharding),
        "step": jax.ShapeDtypeStruct((), np.int32, sharding=sharding),
    }
    data = _numbers()
    found = checkpoints.restore(abstract, data)
    checkpoints.close()
    values, left = np.asarray(found["weights"]).tolist(), [int(next(data)) for _ in range(5)]
    return {"newest": f"{values} after {found['step']}, then {left}"}


def _encode(place: Path, inputs: Path, version: int) -> None:
    """Write with placeholders for the networks, which would only take time."""

    class Encoding:
        config = configs.get("debug")

        def __init__(self, *_: object):
            pass

        def __call__(self, triplets: list[Triplet]) -> list[dict[str, np.ndarray]]:
            return [{"target": triplet.target[:, 0, 0].copy()} for triplet in triplets]

    encode.Encoding = Encoding
    Networks.load = lambda *_, **__: None
    encode.encode_shards(
        configs.get("debug"), inputs / "weights", source=ShardReader(inputs / "frames0"),
        out=place / "shards", stride=1, batch_size=1, shard_windows=1,
    )  # fmt: skip


def _make(place: Path, inputs: Path, version: int) -> None:
    """In threads instead of processes, which would have to import everything."""
    dataset.ProcessPoolExecutor = lambda workers, **_: ThreadPoolExecutor(workers)
    tiny = "--frames 5 --height 32 --width 48 --fps 16 --workers 1"
    _run(egosim, f"data make tabletop --scenes 2 {tiny} --out {place}/shards")


def _pack(place: Path, inputs: Path, version: int) -> None:
    metadata = inputs / f"clips{version}" / "metadata.csv"
    _run(egosim, f"data pack --metadata {metadata} --out {place}/shards --overwrite")


def _kept(place: Path) -> tuple[Any, int]:
    compiled = []

    def compile() -> Any:
        compiled.append(1)
        return jax.jit(lambda x: 2 * x).lower(*given).compile()

    os.environ["XDG_CACHE_HOME"] = str(place)
    given = (jax.ShapeDtypeStruct((3,), jnp.float32),)
    return executables.cached_compile("double", given, compile), len(compiled)


def _read_kept(place: Path) -> Read:
    folder = place / "egosim_jax" / "executables"
    if not folder.exists() or not [f for f in folder.iterdir() if not f.name.startswith(".")]:
        return {}
    program, compiled = _kept(place)
    assert not compiled, "it was compiled again"
    return {"program": str(program(jnp.arange(3.0)).tolist())}


def _sheet(place: Path, inputs: Path, version: int) -> None:
    draw_sheet([SheetClip("a", [_frames(version)])], place / "sheet.png", moments=[0, 1])


def _image(path: Path) -> str:
    return _sha256(np.asarray(Image.open(path)))


def _merge(place: Path, inputs: Path, version: int) -> None:
    merge = f"--merge {inputs}/weights --out {place}/out"
    _run(egosim_convert, f"lora {inputs}/lora{version}.safetensors --config debug {merge}")


WRITERS = {
    "snapshot": Writer(
        lambda place, _, version: snapshot.save(place / "state", state(version)),
        _file("state", lambda path: snapshot.fingerprint(snapshot.load(path))),
    ),
    "points": Writer(
        lambda place, _, version: snapshot.write_ply(place / "state.ply", state(version)),
        _file("state.ply", lambda path: _sha256(snapshot.read_ply(path).points_m)),
    ),
    "portrait": Writer(
        lambda place, _, version: write_portrait(
            place / "a.png", state(version), up=np.array([0.0, 0, 1])
        ),
        _file("a.png", _image),
    ),
    "sheet": Writer(_sheet, _file("sheet.png", _image)),
    "video": Writer(
        lambda place, _, version: write_video(place / "a.mp4", _frames(version), 8),
        _file("a.mp4", lambda path: _sha256(read_video(path).frames)),
    ),
    "journal": Writer(
        _journal,
        lambda place: {name: json.dumps(line) for name, line in Journal(place).done.items()},
    ),
    "results": Writer(_append_results, lambda place: _lines(place / "results.jsonl", "video_id")),
    "config": Writer(_config, _read_config),
    "weights": Writer(
        lambda place, inputs, version: _run(
            egosim_convert, f"weights {inputs}/torch{version} --config debug --out {place}/out"
        ),
        _weights,
    ),
    "to-torch": Writer(
        lambda place, inputs, version: _run(
            egosim_convert,
            f"to-torch {inputs}/weights --config debug --only vae --out {place}/out --dtype "
            + ("float16", "bfloat16")[version],
        ),
        _weights,
    ),
    "quantize": Writer(
        lambda place, inputs, version: _run(
            egosim_convert,
            f"quantize {inputs}/weights --out {place}/out --kind {('int8', 'float8')[version]}",
        ),
        _weights,
    ),
    "lora": Writer(
        lambda place, inputs, version: _run(
            egosim_convert,
            f"lora {inputs}/lora{version}.safetensors --config debug "
            f"--out {place}/out/a.safetensors",
        ),
        _weights,
    ),
    "merge": Writer(_merge, _weights),
    "pack": Writer(_pack, _shards, before=False),
    "overwrite": Writer(_pack, _shards),
    "encode": Writer(_encode, _shards, before=False),
    "make": Writer(_make, _shards, before=False),
    "executables": Writer(
        lambda place, _, version: _kept(place), _read_kept, before=False, same_bytes=False
    ),
    "checkpoint": Writer(_checkpoint, _read_checkpoints, same_bytes=False),
}
