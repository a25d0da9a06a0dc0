"""Commands that are killed at random times and run again, until what they write is complete.

The files are then compared, byte for byte, with the files of a run without a kill. Only times and
process numbers are skipped: `IGNORED`, `TIMED` and the seconds in JSON.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.flags import QUICK

ROOT = Path(__file__).parents[2]

IGNORED = {
    ".lock": "the PID of the process that wrote last",
    "simulation.rrd": "Rerun puts a random id and the time of day into a recording",
    "times.json": "seconds",
    "index.html": "the page shows them",
    "checkpoints": "Orbax names files by random ids and notes times; what comes of a checkpoint, "
    "the log and the weights, is compared",
}
"""Files, and folders with all that is in them, that two runs without a kill do not share."""
TIMED = (
    "seconds",
    "step_time_s",
    "chain",
    "data_wait_frac",
    "tflops",
    "mfu",
    "peak_mem_gb",
    "eta_min",
)
"""Fields of a log's lines that depend on the clock, or are a hash over such fields."""
MODEL = "--config debug --weights ../weights"
OF_A_CLIP = "--frames 9 --height 64 --width 96 --fps 16 --workers 1"
MAKE = f"egosim_jax.cli data make tabletop --scenes 3 {OF_A_CLIP}"
OF_AN_ENCODING = "--shard-windows 1 --batch-size 1 --stride 1"
ENCODE = f"egosim_jax.cli data encode {MODEL} --shards ../frames {OF_AN_ENCODING}"
COMMANDS = {
    "simulate": f"egosim_jax.cli simulate {MODEL} --clips 2 --perception oracle",
    "generate": f"egosim_jax.cli generate {MODEL} --limit 2 --skip-existing",
    "make": MAKE,
    "pack": "egosim_jax.cli data pack --metadata ../clips/scenes/metadata.csv --overwrite",
    "encode": ENCODE,
    "train": f"egosim_jax.train egosim_14b_fewshot {MODEL} --latents ../latents --training.steps 8 "
    "--training.batch-size 2 --training.log-every 1 --training.save-every 2",
    "convert": "egosim_jax.convert weights ../torch --config debug",
    "annotate": "tests.crash.commands data annotate ../videos --renderer numpy",
    "robot": "tests.crash.commands robot render ../episode --robot toy",
}
"""Each without its `--out out`; run in a folder next to the folders of `INPUTS`."""
ONCE = ("robot",)
"""Commands that write a new folder in one step, and refuse it when it is there."""
WEIGHTS = "from egosim_jax import configs, testing; from pathlib import Path; "
WEIGHTS += "testing.write_weights(Path('weights'), configs.get('debug'))"
INPUTS = {
    "weights": ["-c", WEIGHTS],
    "torch": [
        "-m",
        "egosim_jax.convert",
        "to-torch",
        "weights",
        "--config",
        "debug",
        "--out",
        "torch",
    ],
    "clips": f"-m egosim_jax.cli generate {MODEL[:-10]}weights --limit 2 --out clips".split(),
    "frames": f"-m {MAKE} --out frames".split(),
    "latents": f"-m {ENCODE} --out latents".replace("../", "").split(),
    "videos": ["-m", "tests.crash.commands", "--make", "videos"],
    "episode": ["-m", "tests.crash.commands", "--make", "episode"],
}
"""Commands that make the inputs of the others, in their order."""


@dataclass
class Tally:
    """Results of the kills of a command."""

    name: str
    seconds: float
    kills: int = 0
    trials: int = 0
    reruns: int = 0
    differences: int = 0

    def __str__(self) -> str:
        counts = f"{self.kills} kills, {self.reruns} reruns, {self.differences} differences"
        return f"{self.name}: {counts} in {self.trials} trials of {self.seconds:.1f} s"


def prepare(folder: Path, commands: Iterable[str]) -> None:
    """Make in `folder` what some commands are given, and what that is made of."""
    folder.mkdir(parents=True, exist_ok=True)
    words = {word.removeprefix("../") for command in commands for word in command.split()}
    for name in reversed(INPUTS):
        words |= {*INPUTS[name]} if name in words else set()
    for name, arguments in INPUTS.items():
        if name in words and not (folder / name).exists():
            _python(arguments, folder)


def kill_often(name: str, folder: Path, *, kills: int, seed: int) -> Tally:
    """Kill a command so many times; several times in each trial, whose end is compared."""
    chance = random.Random(f"{seed} {name}")
    arguments = ["-m", *COMMANDS[name].split(), "--out", "out"]
    _finish(arguments, folder / f"{name}_warm")  # fills the compile cache
    then = time.monotonic()
    wanted = _finish(arguments, folder / f"{name}_reference")
    tally = Tally(name, time.monotonic() - then)
    while tally.kills < kills:
        place = _emptied(folder / f"{name}_{tally.trials}")
        times = [chance.uniform(0, tally.seconds) for _ in range(5)]
        for seconds in times[: kills - tally.kills]:
            if _is_complete(name, place):
                break
            tally.reruns += 1
            if not _killed_after(seconds, arguments, place):
                break
            tally.kills += 1
        else:
            tally.reruns += 1
        done = _is_complete(name, place)
        have = artifacts(place / "out") if done else _finish(arguments, place, restart=False)
        for line in differences(wanted, have):
            tally.differences += 1
            print(f"{place}: {line}", flush=True)
        tally.trials += 1
    return tally


def main(names: Sequence[str], folder: Path, *, kills: int, seed: int) -> int:
    """Kill each of the commands; the exit code."""
    os.environ |= {"XLA_FLAGS": QUICK, "XDG_CACHE_HOME": str(folder.absolute() / "cache")}
    os.environ["PYTHONPATH"] = str(ROOT)
    prepare(folder, [COMMANDS[name] for name in names])
    tallies = []
    for name in names:
        each = -(-kills // len(names))
        tallies.append(kill_often(name, folder, kills=each, seed=seed))
        print(tallies[-1], flush=True)
    print(f"{sum(tally.kills for tally in tallies)} kills in all")
    return int(any(tally.differences for tally in tallies))


def artifacts(folder: Path) -> dict[str, str]:
    """Digests of all files but those that are ignored, by their paths."""
    found = {}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if not IGNORED.keys() & {*parts}:
            found["/".join(parts)] = hashlib.sha256(_content(path)).hexdigest()
    return found


def _content(path: Path) -> bytes:
    if path.is_dir():
        return b"a folder"
    if path.suffix == ".json":
        return json.dumps(_without_times(json.loads(path.read_text("utf-8")))).encode()
    if path.suffix != ".jsonl":
        return path.read_bytes()
    lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    if path.name == "results.jsonl":  # the last line of a clip counts
        lines = sorted({line["video_id"]: line for line in lines}.items())
        lines = [line for _, line in lines]
    return repr([{k: v for k, v in line.items() if k not in TIMED} for line in lines]).encode()


def _without_times(value: Any) -> Any:
    """Return a JSON value without the seconds that its parts took."""
    if isinstance(value, dict):
        return {name: _without_times(v) for name, v in value.items() if name != "seconds"}
    return [_without_times(item) for item in value] if isinstance(value, list) else value


def differences(wanted: dict[str, str], have: dict[str, str]) -> list[str]:
    """Return a line for each path whose digests differ."""
    paths = sorted(wanted.keys() | have.keys())
    return [f"{path} differs" for path in paths if wanted.get(path) != have.get(path)]


def _is_complete(name: str, place: Path) -> bool:
    """Return True if a command would refuse the folder that it wrote."""
    return name in ONCE and (place / "out").exists()


def _emptied(place: Path) -> Path:
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    return place


def _finish(arguments: Sequence[str], place: Path, *, restart: bool = True) -> dict[str, str]:
    _python(arguments, _emptied(place) if restart else place)
    return artifacts(place / "out")


def _python(arguments: Sequence[str], place: Path) -> None:
    ran = subprocess.run([sys.executable, *arguments], cwd=place, capture_output=True, text=True)
    assert ran.returncode == 0, f"{arguments}: {ran.stderr[-3000:]}"


def _killed_after(seconds: float, arguments: Sequence[str], place: Path) -> bool:
    """Start a process group and kill it; whether it had not ended by itself."""
    with (place / "log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, *arguments], cwd=place, stdout=log, stderr=log, start_new_session=True
        )
    try:
        code = process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True
    assert code == 0, (place / "log").read_text("utf-8")[-3000:]
    return False
