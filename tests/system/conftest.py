"""Inputs that every command can start from."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from egosim_jax.evaluation.metrics import lpips


@pytest.fixture(scope="session")
def weights(debug_weights: Path) -> Path:
    """Random weights of `debug`."""
    return debug_weights


@pytest.fixture(scope="module")
def without_lpips() -> Iterator[None]:
    """Compute no LPIPS: it is slow in the tests' code, and has its own tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lpips, "load_if_installed", lambda name: None)
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole commands take minutes."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow)
