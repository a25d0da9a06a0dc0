"""A camera that is not there ends `egosim play` before anything is loaded."""

from importlib.util import find_spec

import pytest

from egosim_jax.cli.play import Play
from egosim_jax.perception.video.hands import litert
from egosim_jax.types import InputError


@pytest.mark.skipif(find_spec("viser") is None, reason="needs viser")  # an extra
def test_a_camera_that_is_not_there_ends_the_command_before_anything_is_loaded(monkeypatch):
    monkeypatch.setattr(litert, "fetch_weights", lambda: ())
    monkeypatch.setattr(litert, "HandNetworks", lambda *_, **__: None)
    with pytest.raises(InputError, match=r"Camera 77 cannot be opened"):
        Play(camera="77", port=0).run()
