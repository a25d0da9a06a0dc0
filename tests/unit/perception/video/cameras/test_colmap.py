"""Child processes that crash, hang or are missing."""

import sys
import tempfile
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.io.untrusted.isolated import Child
from egosim_jax.perception.video.cameras import CameraLadder, ColmapConfig, ColmapError, colmap
from egosim_jax.perception.video.cameras.flow import background
from egosim_jax.types import InputError
from tests.unit.perception.video.cameras import steps
from tests.unit.perception.video.cameras.room import path, render


def match(config: ColmapConfig) -> None:
    frames = render(path(2))
    video = background(frames, np.zeros(frames.shape[:3], bool))
    with colmap.open_scene(video, (0, 1), config=config) as scene:
        scene.child.call(repr, config, timeout_s=60.0)  # its imports are not part of the time limit
        scene.match()


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


def test_a_crash_is_reported_with_its_last_message(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap, "match_features", steps.crash)
    with pytest.raises(ColmapError, match="features was ended by SIGABRT: no memory"):
        match(ColmapConfig())
    assert not list(temporary.iterdir())


def test_a_hang_is_ended_with_all_its_processes(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap, "match_features", partial(steps.hang, tmp_path / "pid"))
    with pytest.raises(ColmapError, match="took longer than 2 s"):
        match(ColmapConfig(timeout_s=2.0))
    grandchild = int((tmp_path / "pid").read_text())
    for _ in range(100):
        if not _alive(grandchild):
            break
        time.sleep(0.05)
    assert not _alive(grandchild)
    assert not list(temporary.iterdir())


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_crash_is_a_reason_and_no_rung(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap, "match_features", steps.leave)
    frames = render(path(6, move=np.array([0.5, 0.0, 0.0])))
    found = CameraLadder()(frames, np.zeros(frames.shape[:3], bool))
    assert found.verdict.rung == "refused"
    assert found.cameras is None
    assert "incremental: COLMAP's step features failed with exit code 3" in found.verdict.reason


def test_a_missing_pycolmap_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'egosim-jax\[video\]'"):
        match(ColmapConfig())


def test_the_child_never_imports_opencv() -> None:
    with closing(Child()) as child:
        modules = child.call(steps.modules, colmap.match_features, ColmapConfig(), timeout_s=60.0)
    assert colmap.__name__ in modules
    assert "cv2" not in modules
