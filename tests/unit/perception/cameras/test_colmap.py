"""Child processes that crash, hang or are missing."""

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.perception.cameras import CameraLadder, ColmapConfig, ColmapError, colmap
from egosim_jax.perception.cameras.flow import background
from egosim_jax.types import InputError
from tests.unit.perception.cameras.room import path, render

HANGS = """
import subprocess, sys, time, pathlib
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
pathlib.Path(r"{}").write_text(str(child.pid))
time.sleep(600)
"""


def match(config: ColmapConfig) -> None:
    frames = render(path(2))
    video = background(frames, np.zeros(frames.shape[:3], bool))
    with colmap.open_scene(video, (0, 1), height=240, width=320, config=config) as scene:
        scene.match()


def use(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "child.py").write_text(program)
    monkeypatch.setattr(colmap, "CHILD", tmp_path / "child.py")


def test_a_crash_is_reported_with_its_last_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use("import os, sys; print('no memory', file=sys.stderr, flush=True); os.abort()", tmp_path,
        monkeypatch)  # fmt: skip
    with pytest.raises(ColmapError, match="features was ended by SIGABRT: no memory"):
        match(ColmapConfig())
    assert not list((tmp_path / "temporary").iterdir())


def test_a_hang_is_ended_with_all_its_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(HANGS.format(tmp_path / "pid"), tmp_path, monkeypatch)
    with pytest.raises(ColmapError, match="took longer than 2 s"):
        match(ColmapConfig(timeout_s=2.0))
    grandchild = int((tmp_path / "pid").read_text())
    for _ in range(100):
        if not _alive(grandchild):
            break
        time.sleep(0.05)
    assert not _alive(grandchild)
    assert not list((tmp_path / "temporary").iterdir())


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_crash_is_a_reason_and_no_rung(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use("raise SystemExit(3)", tmp_path, monkeypatch)
    frames = render(path(6, move=np.array([0.5, 0.0, 0.0])))
    found = CameraLadder()(frames, np.zeros(frames.shape[:3], bool))
    assert found.verdict.rung == "refused"
    assert found.cameras is None
    assert "incremental: COLMAP's step features failed with exit code 3" in found.verdict.reason


def test_a_missing_pycolmap_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'egosim-jax\[video\]'"):
        match(ColmapConfig())


def test_the_child_never_imports_opencv_or_the_package() -> None:
    text = colmap.CHILD.read_text()
    assert "cv2" not in text
    assert "egosim_jax" not in text
    assert os.path.samefile(colmap.CHILD, Path(colmap.__file__).with_name("colmap_child.py"))
