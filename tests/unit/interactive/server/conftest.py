"""Server shared by the tests of a module, and a store of sessions."""

import pytest

from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server.store import Store
from tests.painted import painted
from tests.unit.interactive.server.served import run


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    service, port, _ = run(tmp_path_factory.mktemp("sessions"))
    yield service, port
    service.store.close()


@pytest.fixture
def store(tmp_path):
    opened = Store(tmp_path / "sessions", painted(), Limits())
    yield opened
    opened.close()
