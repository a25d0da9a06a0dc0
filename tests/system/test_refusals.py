"""Errors of the system: each command reports one line, loses nothing, and resumes later."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.convert.__main__ import main as egosim_convert
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.state import snapshot
from egosim_jax.train.__main__ import main as egosim_train
from tests.crash import writers

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.geteuid() != 0, reason="only root mounts small or read-only file systems"
    ),
]
MODEL = "--config debug --weights {made}/weights"
CLIPS = "--metadata {made}/clips0/metadata.csv"
TINY = "--frames 9 --height 64 --width 96 --fps 16 --workers 1"
FEW = "--vae.steps 1 --denoiser.steps 1"
PROGRAMS = {"egosim": egosim, "egosim-train": egosim_train, "egosim-convert": egosim_convert}
COMMANDS = {
    "simulate": f"egosim simulate {MODEL} --clips 1 --perception oracle --out {{out}}",
    "generate": f"egosim generate {MODEL} {CLIPS} --limit 1 --out {{out}}",
    "make": f"egosim data make tabletop --scenes 1 {TINY} --out {{out}}",
    "pack": f"egosim data pack {CLIPS} --out {{out}}",
    "encode": f"egosim data encode {MODEL} --shards {{made}}/frames0 --out {{out}}",
    "look": "egosim data look --shards {made}/frames0 --out {out}/sheet.png",
    "evaluate": f"egosim evaluate --generated {{made}}/generated {CLIPS} --out {{out}}",
    "view": "egosim view {made}/state --out {out}/view.png",
    "experiment": f"egosim experiment tabletop {MODEL} --scenes 2 --seeds 1 --out {{out}}",
    "debug": f"egosim-train debug --out {{out}} --clips 4 {FEW}",
    "tabletop": f"egosim-train tabletop --config debug --scenes 2 --held-out 2 --out {{out}} {FEW}",
    "weights": "egosim-convert weights {made}/torch0 --config debug --out {out}",
    "lora": "egosim-convert lora {made}/lora0.safetensors --config debug --out {out}/a.safetensors",
    "merge": "egosim-convert lora {made}/lora0.safetensors --config debug --merge {made}/weights "
    "--out {out}",
    "to-torch": "egosim-convert to-torch {made}/weights --config debug --out {out}",
}
LONG = {"experiment", "debug", "tabletop"}
"""Commands that take minutes; only their end is tested."""
FREE = {"evaluate": 1, "view": 1, "lora": 1, "look": 1}
"""Free pages of the full disk by command; 8 for the others."""
PASSING = (".lock", ".tmp", ".part")
"""Suffixes of files that exist only until the command is complete."""
PARTS = "/parts/"
"""Folder that exists only until the command is complete."""
UNLOCKED = {"pack", "look", "evaluate", "view", "weights", "lora", "merge", "to-torch"}
"""Commands that write atomically, so that two at once cannot corrupt anything."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    writers.inputs(folder)
    snapshot.save(folder / "state", writers.state(0))
    for clip in "ab":
        target = read_video(folder / "clips0" / clip / "video.mp4")
        write_video(folder / "generated" / f"{clip}.mp4", target.frames, 16)
    return folder


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts a file system with these options, or mounts it again with others."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(options: str) -> Path:
        again = "remount," if folder.is_mount() else ""
        subprocess.run(["mount", "-t", "tmpfs", "-o", again + options, "tmpfs", folder], check=True)
        return folder

    yield mount
    if folder.is_mount():
        subprocess.run(["umount", "--lazy", folder], check=True)


def run(name: str, made: Path, out: Path) -> int:
    program, *arguments = COMMANDS[name].format(made=made, out=out).split()
    return PROGRAMS[program](arguments)


def refused(code: int, capfd: pytest.CaptureFixture[str]) -> str:
    """The line that says why a command ended."""
    said = capfd.readouterr().err
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert code in (1, 2), said
    assert len(errors) == 1, said
    assert "Traceback" not in said
    return errors[0]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def continues(path: str, data: bytes, kept: dict[str, bytes]) -> bool:
    """Return True if a file is kept as it was; a journal may have more lines."""
    found = kept.get(path, b"")
    return found.startswith(data) if path.endswith("journal.jsonl") else found == data


@pytest.mark.parametrize("name", COMMANDS)
def test_on_a_full_disk_a_command_says_so_and_goes_on_when_there_is_room(name, made, disk, capfd):
    folder = disk("size=64k")
    (folder / "mine").write_bytes(bytes((16 - FREE.get(name, 8)) * 4096))
    why = refused(run(name, made, folder / "out"), capfd)
    assert "No space left" in why or "GB free" in why
    before = contents(folder)
    disk("size=200m")
    if name not in LONG:
        assert run(name, made, folder / "out") == 0, capfd.readouterr().err
        kept = contents(folder)
        changed = {path for path, data in before.items() if not continues(path, data, kept)}
        assert not {path for path in changed if not path.endswith(PASSING) and PARTS not in path}
        assert not [path for path in kept if ".tmp" in path or ".part" in path]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_cannot_be_written_is_named(name, made, disk, capfd):
    disk("size=1m")
    folder = disk("ro")
    why = refused(run(name, made, folder / "out"), capfd)
    assert "Read-only file system" in why
    assert str(folder) in why


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_where_a_folder_has_to_be_is_named_and_stays(name, made, tmp_path, capfd):
    out = tmp_path / "out"
    out.write_text("mine", "utf-8")
    assert str(out) in refused(run(name, made, out), capfd)
    assert out.read_text("utf-8") == "mine"


@pytest.mark.parametrize("name", sorted(COMMANDS.keys() - UNLOCKED))
def test_a_second_process_is_refused_while_the_first_one_writes(name, made, tmp_path, capfd):
    out = tmp_path / "out"
    hold = "import sys; from pathlib import Path; from egosim_jax.io.atomic import hold_folder; "
    hold += "hold_folder(Path(sys.argv[1])); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", hold, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as first:
        assert first.stdout is not None
        first.stdout.readline()
        before = contents(out)
        assert f"PID {first.pid}" in refused(run(name, made, out), capfd)
        assert contents(out) == before
        first.communicate()


@pytest.mark.parametrize("name", ["make", "generate", "weights"])
def test_an_interrupt_is_one_line(name, made, tmp_path):
    """At any time, imports included; like Ctrl-C, it reaches all processes of a command."""
    program, *arguments = COMMANDS[name].format(made=made, out=tmp_path / "out").split()
    module = {"egosim": "cli", "egosim-convert": "convert"}[program]
    chance = random.Random(name)
    for _ in range(2):
        process = subprocess.Popen(
            [sys.executable, "-m", f"egosim_jax.{module}", *arguments],
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        time.sleep(chance.uniform(0.5, 5))
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate(timeout=60)[1]
        if process.returncode == 0:
            continue
        assert process.returncode in (130, -signal.SIGINT), said
        assert "Traceback" not in said
        printed = [line for line in said.splitlines() if line.startswith("interrupted")]
        assert len(printed) == 1, said
        assert printed[0] == "interrupted" or str(tmp_path / "out") in printed[0]
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
