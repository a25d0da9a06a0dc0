"""Server shared by the tests of a module."""

import pytest

from tests.unit.interactive.server.served import run


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    service, port, _ = run(tmp_path_factory.mktemp("sessions"))
    yield service, port
    service.store.close()
