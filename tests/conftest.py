"""Programs compile quickly; workers, what they start and the next run share them."""

import gc
import os
import re
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.flags import QUICK

os.environ.setdefault("XLA_FLAGS", QUICK)
CACHE = Path(__file__).parents[1] / ".pytest_cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE / "compiled"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ["XDG_CACHE_HOME"] = str(CACHE / "home")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # the workers use all cores; more threads spin
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # torchrl imports ray, which then reads it

NEEDS_TORCH = re.compile(r"^(?:import|from) torch\b", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Compare with torch only where it is installed: the `test` extra has it below Python 3.12."""
    if find_spec("torch") is None and collection_path.suffix == ".py":
        return NEEDS_TORCH.search(collection_path.read_text()) is not None or None
    return None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Exempt imported modules from searches for garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the files that have slow tests, so that none is left to one worker at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, object, object]:
    """Exempt what a finished module keeps, such as jax's traces: a search took 7 seconds."""
    done = yield
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
        gc.freeze()
    return done


@pytest.fixture(scope="session")
def debug_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of `debug`, which no test changes."""
    from egosim_jax import configs
    from egosim_jax.testing import write_weights

    return write_weights(tmp_path_factory.mktemp("debug"), configs.get("debug"))
