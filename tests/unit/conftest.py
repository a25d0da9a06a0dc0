"""Tiny clips on disk, in the layout of EgoSim's metadata, and a version of cuDNN."""

from functools import partial
from importlib import import_module

import jax
import pytest

from egosim_jax import testing


@pytest.fixture
def make_clips(tmp_path):
    """Return a function that writes so many clips and their metadata (`testing.write_dataset`)."""
    return partial(testing.write_dataset, tmp_path)


@pytest.fixture
def clips(make_clips):
    """Metadata of two clips of 9 frames, 48x32."""
    return make_clips()


@pytest.fixture
def cudnn_version(monkeypatch):
    """Let programs with jax's cuDNN attention be traced where cuDNN is not installed.

    jax asks for its version while it traces, and has no public way to name one.
    """
    try:
        module = import_module("jax._src.cudnn.fused_attention_stablehlo")
        monkeypatch.setattr(module, "check_cudnn_version", lambda: 91000)
    except (ImportError, AttributeError) as error:
        pytest.fail(f"jax {jax.__version__} changed: {error}, which tests/unit/conftest.py uses.")
