"""Joining the processes of a run, and running alone."""

import os
import socket
import subprocess
import sys
import warnings

import jax
import pytest

from egosim_jax.train import distributed
from egosim_jax.types import InputError


def resolve_hostname(monkeypatch, address):
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)


@pytest.fixture
def initialized(monkeypatch):
    """The arguments of `jax.distributed.initialize`, which is not called."""
    calls = []
    for name in distributed.NAMES:
        monkeypatch.delenv(name, raising=False)

    def initialize(*address, **options):
        if not address:
            raise ValueError("no cluster")
        calls.append((address, options))

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    monkeypatch.setattr(jax.distributed, "shutdown", lambda: None)
    resolve_hostname(monkeypatch, "127.0.0.1")
    before = jax.config.values["jax_cpu_collectives_implementation"]
    yield calls
    jax.config.update("jax_cpu_collectives_implementation", before)


def test_a_process_on_its_own_listens_on_loopback_and_may_be_suspended(initialized):
    with distributed.distributed_context():
        pass
    ((address, options),) = initialized
    assert options["coordinator_bind_address"] == address[0]
    assert address[0].startswith("127.0.0.1:")
    assert options["heartbeat_timeout_seconds"] > 3600
    assert jax.config.values["jax_cpu_collectives_implementation"] is None  # nor does gloo listen


@pytest.mark.parametrize(
    ("host", "bound"), [("127.0.0.1", True), ("localhost", True), ("10.1.2.3", False)]
)
def test_several_processes_listen_where_their_address_says(initialized, monkeypatch, host, bound):
    for name, value in zip(distributed.NAMES, (f"{host}:1234", "2", "0"), strict=True):
        monkeypatch.setenv(name, value)
    with distributed.distributed_context():
        pass
    ((_, options),) = initialized
    assert (options["coordinator_bind_address"] == f"{host}:1234") == bound
    assert options["heartbeat_timeout_seconds"] == 45
    assert jax.config.values["jax_cpu_collectives_implementation"] == "gloo"


@pytest.mark.parametrize(
    ("address", "index", "warned"),
    [("127.0.1.1", "0", False), ("192.0.2.7", "0", True), ("192.0.2.7", "1", False)],
)
def test_gloo_beyond_the_loopback_is_said_once(initialized, monkeypatch, address, index, warned):
    resolve_hostname(monkeypatch, address)
    for name, value in zip(distributed.NAMES, ("127.0.0.1:1234", "2", index), strict=True):
        monkeypatch.setenv(name, value)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with distributed.distributed_context():
            pass
    assert [address in str(warning.message) for warning in said] == [True] * warned


@pytest.mark.usefixtures("initialized")
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((None, "2", None), "JAX_COORDINATOR_ADDRESS, JAX_PROCESS_ID is not"),
        (("127.0.0.1:1", "2", "2"), "JAX_PROCESS_ID=2"),
    ],
)
def test_an_incomplete_or_invalid_process_environment_is_refused(monkeypatch, given, said):
    for name, value in zip(distributed.NAMES, given, strict=True):
        if value is not None:
            monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match=said), distributed.distributed_context():
        pass


def test_the_only_task_of_a_machine_has_all_of_its_gpus(monkeypatch):
    """With jax's own detection of Slurm, which gives each task one GPU."""
    code = (
        "import jax; from egosim_jax.train.distributed import distributed_context\n"
        "with distributed_context(): print(jax.config.values['jax_cuda_visible_devices'])"
    )
    shared = {
        "SLURM_JOB_ID": str(os.getpid()),  # gives the port
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": "2",
        "SLURM_STEP_NUM_TASKS": "2",
        "SLURM_STEP_NUM_NODES": "2",
        "SLURM_LOCALID": "0",
    }
    tasks = [
        subprocess.Popen(
            [sys.executable, "-c", code],
            env=os.environ | shared | {"SLURM_PROCID": index},
            stdout=subprocess.PIPE,
            text=True,
        )
        for index in ("0", "1")
    ]
    assert [task.communicate(timeout=300)[0].strip() for task in tasks] == ["all", "all"]
    for name, value in shared.items():
        monkeypatch.setenv(name, value)
    assert distributed._is_alone_on_machine()
    monkeypatch.setenv("SLURM_STEP_NUM_NODES", "1")
    assert not distributed._is_alone_on_machine()
