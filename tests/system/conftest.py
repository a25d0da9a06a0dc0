"""Inputs that every command can start from."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def weights(debug_weights: Path) -> Path:
    """Random weights of `debug`."""
    return debug_weights


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole commands take minutes."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow)
