"""Compiled programs are found again, and only by those who may."""

import os

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from egosim_jax.io import executables
from egosim_jax.io.executables import kept

GIVEN = (jax.ShapeDtypeStruct((3,), jnp.float32),)
WIDE = jax.ShapeDtypeStruct((64, 64), jnp.float32)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "egosim_jax" / "executables"


@pytest.fixture
def double():
    """What compiles a program, and how often it did."""

    def compile():
        compile.times += 1
        return jax.jit(lambda x: 2 * x).lower(*GIVEN).compile()

    compile.times = 0
    return compile


def test_a_program_is_compiled_once(folder, double):
    first, second = (kept("double", GIVEN, double) for _ in range(2))
    x = jnp.arange(3.0)
    assert double.times == 1
    assert (first(x) == 2 * x).all()
    assert (second(x) == 2 * x).all()
    assert second.out_info.shape == (3,)


def test_the_folder_is_the_users_alone(folder, double):
    kept("double", GIVEN, double)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(list(folder.iterdir())) == 1


def test_a_folder_that_others_can_write_is_not_used(folder, double):
    folder.mkdir(parents=True)
    folder.chmod(0o770)
    for _ in range(2):
        kept("double", GIVEN, double)
    assert double.times == 2
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    "change",
    [
        lambda patch: patch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " "),
        lambda patch: patch.setattr(executables, "_code", lambda: "of tomorrow"),
        lambda patch: patch.setattr(executables, "_processor", lambda: "another"),
        lambda patch: patch.setattr(executables.metadata, "version", lambda name: "9"),
    ],
    ids=["flags", "code", "processor", "versions"],
)
def test_what_a_program_depends_on_tells_it_from_others(folder, double, change, monkeypatch):
    kept("double", GIVEN, double)
    change(monkeypatch)
    kept("double", GIVEN, double)
    assert double.times == 2


def test_another_config_or_shape_is_another_program(folder, double):
    other = (jax.ShapeDtypeStruct((4,), jnp.float32),)
    for about, given in (("double", GIVEN), ("half", GIVEN), ("double", other)):
        kept(about, given, double)
    assert double.times == 3


def test_a_damaged_file_is_made_again(folder, double):
    kept("double", GIVEN, double)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    with pytest.warns(UserWarning, match="compiled again"):
        kept("double", GIVEN, double)
    assert double.times == 2
    kept("double", GIVEN, double)
    assert double.times == 2


def test_the_oldest_are_forgotten(folder, double, monkeypatch):
    monkeypatch.setattr(executables, "MOST", 2)
    for number in range(4):
        kept(number, GIVEN, double)
    assert len(list(folder.iterdir())) == 2
    kept(3, GIVEN, double)
    assert double.times == 4


def test_what_jaxs_own_cache_has_is_kept_whole(folder, tmp_path):
    """A CPU's program that was read from there would be written without its functions."""

    def compile():
        return jax.jit(lambda x: jnp.sort(jnp.sin(x) @ jnp.cos(x))).lower(WIDE).compile()

    least = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[least], jax.config.values["jax_compilation_cache_dir"]
    jax.config.update(least, 0)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    compilation_cache.reset_cache()
    try:
        x = jnp.eye(64)
        compile()
        assert list((tmp_path / "jax").glob("*-cache"))
        jax.clear_caches()
        want = kept("sorted", (WIDE,), compile)(x)
        assert (kept("sorted", (WIDE,), compile)(x) == want).all()
    finally:
        jax.config.update(least, before[0])
        jax.config.update("jax_compilation_cache_dir", before[1])
        compilation_cache.reset_cache()
