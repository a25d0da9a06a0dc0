"""Compiled functions are found in the cache, and only by their user."""

import dataclasses
import importlib
import os
import random
import shutil
import subprocess
import sys
import types
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from flax import nnx
from jax.experimental.compilation_cache import compilation_cache

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.generation.generator import Generator
from egosim_jax.io import executables, private
from egosim_jax.io.executables import cached_compile, cached_trace
from egosim_jax.io.private import PrivateCache
from egosim_jax.models import abstract
from tests.flags import devices

GIVEN = (jax.ShapeDtypeStruct((3,), jnp.float32),)
WIDE = jax.ShapeDtypeStruct((64, 64), jnp.float32)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "egosim_jax" / "executables"


@pytest.fixture
def double():
    """A function that compiles, and counts its calls."""

    def compile():
        compile.times += 1
        return jax.jit(lambda x: 2 * x).lower(*GIVEN).compile()

    compile.times = 0
    return compile


def test_a_function_is_compiled_once(folder, double):
    first, second = (cached_compile("double", GIVEN, double) for _ in range(2))
    x = jnp.arange(3.0)
    assert double.times == 1
    assert (first(x) == 2 * x).all()
    assert (second(x) == 2 * x).all()
    assert second.out_info.shape == (3,)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(list(folder.iterdir())) == 1


FOUR = (jax.ShapeDtypeStruct((4,), jnp.float32),)
CHANGES = {
    "key": lambda patch: ("half", GIVEN),
    "shape": lambda patch: ("double", FOUR),
    "flags": lambda patch: patch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " "),
    "versions": lambda patch: patch.setattr(executables.metadata, "version", lambda name: "9"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_each_dependency_is_part_of_the_key(folder, double, change, monkeypatch):
    cached_compile("double", GIVEN, double)
    cached_compile(*(CHANGES[change](monkeypatch) or ("double", GIVEN)), double)
    assert double.times == 2


def test_every_module_that_runs_while_tracing_is_part_of_the_key():
    config = configs.get("debug")
    generator = Generator(config, Networks.abstract(config))
    files = set()

    def record(frame, event, _):
        if event == "call":
            files.add(frame.f_code.co_filename)

    jax.clear_caches()
    programs = [
        (function, args)
        for streamed in (False, True)
        for _, function, args in generator.programs(1, streamed=streamed)
    ]
    for function, args in programs:
        sys.setprofile(record)
        try:
            function.trace(*args)
        finally:
            sys.setprofile(None)
    package = executables.PACKAGE.resolve()
    ran = {Path(file).resolve() for file in files}
    ours = {path.relative_to(package) for path in ran if path.is_relative_to(package)}
    assert [path for path in ours if not any(map(path.is_relative_to, executables.TRACED))] == []


OUTSIDE = """
from dataclasses import dataclass

from egosim_jax.diffusion.solver import Euler


@dataclass(frozen=True, kw_only=True)
class Outside(Euler):
    pass
"""


@pytest.mark.parametrize("place", ["outside_module.py", "outside_package/solver.py"])
def test_modules_outside_the_package_are_part_of_the_key(
    folder, double, tmp_path, monkeypatch, place
):
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / place
    file.parent.mkdir(exist_ok=True)
    file.write_text(OUTSIDE)
    module = importlib.import_module(place.removesuffix(".py").replace("/", "."))
    config = dataclasses.replace(configs.get("debug"), solver=module.Outside())
    for _ in range(2):
        cached_compile(("denoise", config), GIVEN, double)
    assert double.times == 1
    file.write_text(OUTSIDE + "# edited")
    cached_compile(("denoise", config), GIVEN, double)
    assert double.times == 2
    (file.parent / "another.py").write_text("x = 1")
    cached_compile(("denoise", config), GIVEN, double)
    assert double.times == (3 if "/" in place else 2)  # all modules of a package count


def test_a_class_without_a_source_file_is_not_cached(folder, double, monkeypatch):
    module = types.ModuleType("typed_in")
    monkeypatch.setitem(sys.modules, "typed_in", module)
    key = type("Solver", (), {"__module__": "typed_in", "__repr__": lambda self: "Solver"})()
    for _ in range(2):
        cached_compile(key, GIVEN, double)
    assert double.times == 2


def test_every_flipped_bit_is_noticed_before_anything_is_loaded(folder, double, monkeypatch):
    cached_compile("double", GIVEN, double)
    (path,) = folder.iterdir()
    generator = random.Random(0)
    monkeypatch.setattr(executables.pickle, "loads", lambda data: pytest.fail("it was loaded"))
    for case in range(50):
        damaged = bytearray(path.read_bytes())
        damaged[generator.randrange(len(damaged))] ^= 1 << generator.randrange(8)
        path.write_bytes(damaged)
        with pytest.warns(UserWarning, match="damaged"):
            cached_compile("double", GIVEN, double)
        assert double.times == case + 2
        assert path.read_bytes() != damaged


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda path: path.chmod(0o640), "others may use it"),
        (lambda path: os.link(path, path.parent.parent / "second"), "2 names"),
        (lambda path: path.symlink_to(path.rename(path.parent.parent / "moved")), "symbolic"),
        (lambda path: (path.unlink(), os.mkfifo(path)), "not a regular file"),
        (lambda path: os.chown(path, 12345, -1), "belongs to user 12345"),
    ],
    ids=["mode", "hard link", "symbolic link", "pipe", "owner"],
)
def test_a_file_that_others_could_have_written_is_not_loaded(folder, double, change, why):
    cached_compile("double", GIVEN, double)
    (path,) = folder.iterdir()
    change(path)
    with pytest.warns(UserWarning, match=why):
        cached_compile("double", GIVEN, double)
    assert double.times == 2
    cached_compile("double", GIVEN, double)
    assert double.times == 2
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda folder: os.chown(folder, 12345, -1), "belongs to user 12345"),
        (lambda folder: folder.symlink_to(folder.rename(folder.with_name("else"))), "is a link"),
        (lambda folder: folder.parent.parent.chmod(0o777), "others may rename it"),
        (lambda folder: folder.chmod(0o770), "others may use it"),
    ],
    ids=["owner", "link", "above", "mode"],
)
def test_a_folder_that_others_could_change_is_not_used(folder, double, change, why):
    cached_compile("double", GIVEN, double)
    change(folder)
    with pytest.warns(UserWarning, match=why):
        cached_compile("double", GIVEN, double)
    assert double.times == 2


@pytest.mark.parametrize("value", ["", "cache"])
def test_an_empty_or_relative_cache_home_is_not_the_working_folder(tmp_path, monkeypatch, value):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    assert private.cache_folder() == tmp_path / ".cache" / "egosim_jax"


JAX = """
import jax, jax.numpy as jnp
from egosim_jax.io import executables

events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
executables.JAX_MAX_FILES = {most}
executables.share_with_jax()
print(float(jax.jit(lambda x: jnp.sort(jnp.sin(x) @ jnp.cos(x)).sum())(jnp.eye(8))))
print(events.count("/jax/compilation_cache/cache_hits"))
"""


def run_with_jax(home: Path, most: int = 1024) -> tuple[Path, float, int, str]:
    """Run a program that shares the cache with jax; its folder, result, hits and warnings."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    environment["XDG_CACHE_HOME"] = str(home)
    done = subprocess.run(
        [sys.executable, "-c", JAX.format(most=most)],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    value, hits = done.stdout.split()
    return home / "egosim_jax" / "jax", float(value), int(hits), done.stderr


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """The cache home of a first run, a copy of it, and the result, hits and warnings."""
    home = tmp_path_factory.mktemp("filled") / "home"
    _, *seen = run_with_jax(home)
    return home, shutil.copytree(home, home.with_name("copy")), *seen


@pytest.fixture
def with_jax(filled):
    """The folder and result of a first run, and a function that runs the program again."""
    home, copy, want, *_ = filled  # jax's keys depend on the path
    shutil.rmtree(home)
    shutil.copytree(copy, home)
    return home / "egosim_jax" / "jax", want, partial(run_with_jax, home)


def test_jaxs_own_cache_is_private_and_bounded(with_jax, filled):
    folder, want, run = with_jax
    assert filled[3:] == (0, "")
    assert folder.stat().st_mode & 0o777 == 0o700
    files = set(folder.iterdir())
    assert run() == (folder, want, len(files), "")
    oldest = min(files, key=lambda path: path.name)
    os.utime(oldest, (1, 1))
    (folder / "of_xla").mkdir()  # XLA's caches for GPUs are folders in it
    assert run(most=len(files) - 1) == (folder, want, len(files) - 1, "")


def test_jax_compiles_again_what_was_cut_off(with_jax):
    folder, want, run = with_jax
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:-40])
    _, got, hits, stderr = run()
    assert (got, hits) == (want, 0)
    assert "Error reading persistent compilation cache entry" in stderr


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda folder: folder.chmod(0o777), "others may use it"),
        (lambda folder: ((folder / "a").mkdir(), (folder / "a/b").symlink_to("c")), "a/b. Remove"),
    ],
    ids=["mode", "link below"],
)
def test_jax_does_not_read_what_others_could_have_written(with_jax, change, why):
    folder, want, run = with_jax
    change(folder)
    _, got, hits, stderr = run()
    assert (got, hits) == (want, 0)
    assert why in stderr


def test_the_oldest_are_deleted(folder, double, monkeypatch):
    monkeypatch.setattr(executables, "MAX_FILES", 2)
    for number in range(4):
        cached_compile(number, GIVEN, double)
    assert len(list(folder.iterdir())) == 2
    cached_compile(3, GIVEN, double)
    assert double.times == 4


def test_a_file_that_another_process_removes_costs_nothing(folder, monkeypatch):
    cache = PrivateCache.open("some", most=1)
    assert cache is not None
    cache.put("first", b"1")
    scandir = os.scandir

    @contextmanager
    def raced(folder):
        with scandir(folder) as entries:
            listed = list(entries)
        if "second" in {entry.name for entry in listed}:
            (cache.folder / "first").unlink()
        yield listed

    monkeypatch.setattr("egosim_jax.io.private.os.scandir", raced)
    cache.put("second", b"2")  # a warning would be an error here
    monkeypatch.undo()
    assert cache.get("second") == b"2"
    assert not (cache.folder / "first").exists()


def test_what_jaxs_own_cache_has_is_stored_completely(folder, tmp_path):
    """CPU executables loaded from it would be written without their functions."""

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
        want = cached_compile("sorted", (WIDE,), compile)(x)
        assert (cached_compile("sorted", (WIDE,), compile)(x) == want).all()
    finally:
        jax.config.update(least, before[0])
        jax.config.update("jax_compilation_cache_dir", before[1])
        compilation_cache.reset_cache()


ONE_OF_TWO = """
import jax
from egosim_jax.io.executables import cached_compile, cached_trace
from egosim_jax.io.private import PrivateCache
from egosim_jax.models import abstract
from tests.flags import devices

given = (jax.ShapeDtypeStruct((3,), "float32"),)
compile_fn = lambda: jax.jit(lambda x: 2 * x).lower(*given).compile()  # noqa: E731
for _ in range(2):
    print(cached_compile("one of two", given, compile_fn)(jax.numpy.arange(3.0)))
"""


def test_a_function_of_one_device_is_loaded_for_one_of_several(tmp_path):
    environment = os.environ | devices(2) | {"XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", ONE_OF_TWO], env=environment, capture_output=True, text=True
    )
    assert done.stdout == "[0. 2. 4.]\n" * 2, done.stderr


def activate(x):
    return x


@pytest.fixture
def network():
    """A traced object, and the number of its traces."""

    def trace():
        trace.times += 1
        return {"kernel": WIDE, "activation": trace.activation}

    trace.times, trace.activation = 0, activate
    return trace


def test_a_network_is_traced_once(folder, network):
    first, second = (cached_trace("network", network) for _ in range(2))
    assert network.times == 1
    assert first == second
    assert second["activation"] is activate
    cached_trace("another network", network)
    assert network.times == 2
    assert len(list(folder.iterdir())) == 2


def test_a_network_of_the_cache_equals_a_traced_one(folder):
    config = configs.get("tabletop")
    first, second = (Networks.abstract(config) for _ in range(2))
    assert nnx.graphdef(first) == nnx.graphdef(second)
    for name, network in config.networks.items():
        assert nnx.graphdef(getattr(second, name)) == nnx.graphdef(abstract(network))


def test_a_network_with_a_function_without_a_name_is_traced_again(folder, network):
    network.activation = lambda x: x
    for times in (1, 2):
        cached_trace("network", network)
        assert network.times == times
    assert not list(folder.iterdir())
