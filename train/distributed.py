"""Processes of a run, one or many, with jax's coordination service; their end after SIGTERM.

Slurm, Open MPI and TPU pods are recognized by jax. Anywhere else, give every process

    JAX_COORDINATOR_ADDRESS=host:port JAX_NUM_PROCESSES=n JAX_PROCESS_ID=0..n-1

With none of these a run has one process. The service has no authentication.
With an address of this machine's loopback it listens on the loopback only; with any other it
listens on all interfaces, or on `JAX_COORDINATOR_BIND_ADDRESS`, and needs a firewall
(docs/security.md). Between several processes, jax's collectives of CPUs (gloo) listen at the
address of the hostname.
"""

from __future__ import annotations

import ipaddress
import itertools
import json
import os
import socket
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import jax

# jax exports no barrier and no store of its coordination service, and Orbax no store.
from jax._src.distributed import global_state  # noqa: TID251
from orbax.checkpoint import multihost

from egosim_jax.runtime import preemption
from egosim_jax.runtime.command import CommandExit, ExitCode, ProcessExit, run_with_exit_codes
from egosim_jax.train.peers import HEARTBEAT_S, PEER_DIED, is_peer_failure, run_in_child
from egosim_jax.types import InputError

NAMES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
"""Environment variables that describe a run of several processes."""

FOREVER_S = 10**8
"""Heartbeat timeout of a run of one process, which may be suspended for long, in seconds."""

JOIN_S = 300
"""Time for which processes wait at the start for the last one, in seconds."""
FINISH_S = 3600
"""Time for which processes wait at the end for the last one, which may write weights, in seconds.

A process that dies meanwhile is noticed as at any other time."""
FETCH_S = 86_400
"""Time for which processes wait for the last one, which may copy data to its machine, in seconds.

A process that dies meanwhile is noticed as at any other time."""
LEAVE_S = 10.0
"""Time for which a failing process waits for the others, which may fail too, in seconds."""

SCHEDULER = "xla_cpu_enable_concurrency_optimized_scheduler"
"""XLA's flag for parts of a program that run at the same time on CPUs."""

_calls = itertools.count(1)
"""Numbers of the calls of `is_preempted`, the same in all processes."""


@contextmanager
def distributed_context() -> Iterator[None]:
    """Join the processes of the run before any device is used, and leave them at the end.

    A process that fails alone ends here, so that the others notice it. SIGTERM is noted for
    `is_preempted`.
    """
    # jax's service reports a signal once, to one counter of steps. Orbax calls it as well, with
    # another counter.
    jax.config.update("jax_enable_preemption_service", False)
    with preemption.noting(), _joined():
        yield


@contextmanager
def _joined() -> Iterator[None]:
    given = {name: os.environ[name] for name in NAMES if name in os.environ}
    if given:
        if missing := [name for name in NAMES if name not in given]:
            raise InputError(
                f"{', '.join(given)} is set and {', '.join(missing)} is not: a run of several "
                "processes needs all three variables, a run of one process none."
            )
        address, count, index = given.values()
        _check_numbers(count, index)
        _initialize(address, int(count), int(index))
    else:
        try:
            jax.distributed.initialize(
                initialization_timeout=JOIN_S,
                heartbeat_timeout_seconds=HEARTBEAT_S,
                shutdown_timeout_seconds=FINISH_S,
            )
        except ValueError:  # no cluster
            _initialize(free_local_address(), 1, 0)
        else:
            if _is_alone_on_machine() and "JAX_LOCAL_DEVICE_IDS" not in os.environ:
                jax.config.update("jax_cuda_visible_devices", "all")
    try:
        yield
    except BaseException as error:
        if isinstance(error, CommandExit) and not isinstance(error, ProcessExit):
            jax.distributed.shutdown()  # all processes stop at the same step
            raise
        _leave(error)
        raise
    jax.distributed.shutdown()


@contextmanager
def training_context() -> Iterator[None]:
    """Enter `distributed_context`, in a child process if the run has several processes."""
    if _may_have_peers():
        _keep_order()
        run_in_child()
    with distributed_context():
        yield


def _keep_order() -> None:
    """Have XLA run the parts of a program for CPUs one after the other, from the next process on.

    It would else begin what depends on nothing, a message within a loop and one after it too, in an
    order that differs between processes, and gloo knows messages by their order alone.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if SCHEDULER not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{SCHEDULER}=false".strip()


def _leave(error: BaseException) -> None:
    """Leave the processes of a run because of an error; end this one if the others do not leave.

    If they fail as well, all leave together, each with its own error.
    """

    def fail() -> int:
        raise error

    if _may_have_peers() and is_peer_failure(error):
        # `shutdown` would wait for the dead process, then abort.
        print(PEER_DIED, file=sys.stderr)
        code = ExitCode.RESUBMIT
    else:
        leaving = threading.Thread(target=jax.distributed.shutdown, daemon=True)
        leaving.start()
        leaving.join(LEAVE_S)
        if not leaving.is_alive():
            return
        code = run_with_exit_codes(fail)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def wait_for_all(name: str) -> None:
    """Wait until all processes of a run call this, each once for a name, and no device is used."""
    if jax.process_count() > 1:
        everyone = set(range(jax.process_count()))
        multihost.sync_global_processes(name, processes=everyone, timeout=FETCH_S)


def count_distinct(names: Iterable[str]) -> int:
    """Return how many different names the processes of a run have, of a few in each.

    All processes must call this together.
    """
    here = sorted(names)
    texts = _exchanged("names", json.dumps(here) if here else "")
    return len({name for text in texts for name in json.loads(text)})


def _exchanged(topic: str, text: str) -> list[str]:
    """Return what all processes say of a topic; an empty text is not sent.

    All processes must call this equally often, and each waits for the last one. Only hosts take
    part: a program of devices could run at the same time as an update, whose messages gloo would
    then confuse with its own.
    """
    if jax.process_count() == 1:
        return [text] if text else []
    client: Any = global_state.client
    call = f"{topic}/{next(_calls)}"
    if text:
        client.key_value_set(f"{call}/{jax.process_index()}", text)
    client.wait_at_barrier(topic, FETCH_S * 1000)
    return [value for _, value in client.key_value_dir_get(call)]


def is_preempted() -> bool:
    """Return whether to save and stop: True in all processes once one of them got SIGTERM.

    All processes must call this equally often, and each waits for the last one. False outside of
    `preemption.noting`.
    """
    return bool(_exchanged("preempted", "yes" if preemption.is_noted() else ""))


def stop_if_preempted(out: Path) -> None:
    """End a run that is to stop (`is_preempted`), where the same command resumes it."""
    if is_preempted():
        raise CommandExit(_stopped(out), ExitCode.RESUBMIT)


def leave_if_preempted(out: Path) -> None:
    """End this process of a run if it got SIGTERM; called while each works on its own."""
    if preemption.is_noted():
        raise ProcessExit(_stopped(out), ExitCode.RESUBMIT)


def _stopped(out: Path) -> str:
    return f"{out}: stopped; run the same command again"


def launched_context() -> AbstractContextManager[None]:
    """Return `training_context` for a process of a launcher; otherwise only note SIGTERM."""
    return training_context() if _is_launched() else preemption.noting()


def _is_launched() -> bool:
    """Return True for the variables of this module, or Slurm or Open MPI with several tasks."""
    tasks = [os.environ.get(name, "1") for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")]
    return any(name in os.environ for name in NAMES) or any(count != "1" for count in tasks)


def _is_alone_on_machine() -> bool:
    """Return True for the only task of Slurm or Open MPI on its machine, which has all its GPUs.

    jax would give it one: GPU 0, as the number of the task on its machine.
    """
    names = ("SLURM_STEP_NUM_TASKS", "SLURM_STEP_NUM_NODES")
    tasks, nodes = (os.environ.get(name) for name in names)
    alone = tasks is not None and tasks == nodes
    return alone or os.environ.get("OMPI_COMM_WORLD_LOCAL_SIZE") == "1"


def _may_have_peers() -> bool:
    """Return True in a process of a launcher, or on a TPU of several machines in Kubernetes."""
    return _is_launched() or "," in os.environ.get("TPU_WORKER_HOSTNAMES", "")


def _initialize(address: str, count: int, index: int) -> None:
    """Join the service at an address; on the loopback, the service listens on the loopback only."""
    local = _is_loopback(address.rpartition(":")[0])
    options: dict[str, Any] = {
        "coordinator_bind_address": address if local else None,
        "initialization_timeout": JOIN_S,
        "shutdown_timeout_seconds": FINISH_S,
        # All is given; detection would add one GPU a process on Slurm, and warn on Kubernetes.
        "cluster_detection_method": "deactivate",
    }
    if count == 1:
        # One process sends nothing to others. Gloo, the default, would listen all the same.
        jax.config.update("jax_cpu_collectives_implementation", None)
        options["heartbeat_timeout_seconds"] = FOREVER_S
    else:
        options["heartbeat_timeout_seconds"] = HEARTBEAT_S
        if local and index == 0:
            _warn_of_gloo()
    jax.distributed.initialize(address, count, index, **options)


def _warn_of_gloo() -> None:
    """Warn if gloo will listen beyond the loopback: jax has no option for its address."""
    name = socket.gethostname()
    with suppress(OSError):  # of a hostname without an address, for which gloo has its own error
        address = str(socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)[0][4][0])
        if not _is_loopback(address):
            warnings.warn(
                f"Other machines may reach the collectives of these processes: gloo listens at "
                f"{address}, the address of the hostname {name}, without authentication. Add "
                f"'127.0.0.1 {name}' to /etc/hosts, or use a firewall.",
                stacklevel=3,
            )


def _is_loopback(host: str) -> bool:
    """Return whether a host name or address belongs to the loopback."""
    host = host.strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _check_numbers(count: str, index: str) -> None:
    if not (count.isdigit() and index.isdigit() and int(index) < int(count)):
        raise InputError(
            f"JAX_NUM_PROCESSES={count} and JAX_PROCESS_ID={index}: they must be numbers, the "
            "second from 0 to one below the first."
        )


def free_local_address() -> str:
    """Return a free port of the loopback, as host:port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def require_single_process(recipe: str) -> None:
    """Raise `InputError` in a run of several processes."""
    if jax.process_count() > 1:
        raise InputError(
            f"{recipe} makes its own data and trains in one process, not in {jax.process_count()}. "
            "Several processes can only train on latents encoded before (egosim data encode)."
        )
