"""A dataset of latents on disk."""

import pytest

from tests.unit.data.latent_records import write_latents


@pytest.fixture
def folder(tmp_path):
    """Seven records of latents in several shards."""
    return write_latents(tmp_path / "shards")
