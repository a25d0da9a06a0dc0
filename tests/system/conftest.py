"""Inputs that every command can start from."""

from pathlib import Path

import pytest

from egosim_jax import configs
from egosim_jax.testing import write_weights


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of `debug`."""
    folder = tmp_path_factory.mktemp("weights")
    return write_weights(folder, configs.get("debug"))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole commands take minutes."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow)
