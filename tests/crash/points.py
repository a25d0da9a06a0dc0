"""Processes that the kernel kills right before, or halfway through, their n-th change to a folder.

A filter of system calls (seccomp) hands every call that changes files to `watch`, which lets it run
or kills the process. So calls are seen whoever makes them: Python, C, C++ or Rust, in any thread
and child. Writing through shared maps of memory is not a call, and is not seen. x86-64 Linux alone.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import platform
import select
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

AVAILABLE = sys.platform == "linux" and platform.machine() == "x86_64"
"""True if this machine's calls have the numbers below."""

# name: number, arguments that are descriptors, and those that are paths after their folders.
_NOWHERE = -1
CALLS: dict[int, tuple[str, tuple[int, ...], tuple[tuple[int, int], ...]]] = {
    1: ("write", (0,), ()),
    18: ("pwrite64", (0,), ()),
    20: ("writev", (0,), ()),
    296: ("pwritev", (0,), ()),
    328: ("pwritev2", (0,), ()),
    40: ("sendfile", (0,), ()),
    326: ("copy_file_range", (2,), ()),
    275: ("splice", (2,), ()),
    77: ("ftruncate", (0,), ()),
    285: ("fallocate", (0,), ()),
    74: ("fsync", (0,), ()),
    75: ("fdatasync", (0,), ()),
    91: ("fchmod", (0,), ()),
    2: ("open", (), ((_NOWHERE, 0),)),
    85: ("creat", (), ((_NOWHERE, 0),)),
    257: ("openat", (), ((0, 1),)),
    76: ("truncate", (), ((_NOWHERE, 0),)),
    82: ("rename", (), ((_NOWHERE, 0), (_NOWHERE, 1))),
    264: ("renameat", (), ((0, 1), (2, 3))),
    316: ("renameat2", (), ((0, 1), (2, 3))),
    83: ("mkdir", (), ((_NOWHERE, 0),)),
    258: ("mkdirat", (), ((0, 1),)),
    84: ("rmdir", (), ((_NOWHERE, 0),)),
    87: ("unlink", (), ((_NOWHERE, 0),)),
    263: ("unlinkat", (), ((0, 1),)),
    86: ("link", (), ((_NOWHERE, 1),)),
    265: ("linkat", (), ((2, 3),)),
    88: ("symlink", (), ((_NOWHERE, 1),)),
    266: ("symlinkat", (), ((1, 2),)),
    90: ("chmod", (), ((_NOWHERE, 0),)),
    268: ("fchmodat", (), ((0, 1),)),
}
_FLAGS = {2: 1, 257: 2}
"""Index of the argument with the flags, for calls that open a file."""
_WRITES = {1: None, 18: 3}
"""Calls that can be torn, and which argument is their place in the file."""
PATIENCE = 60
"""Seconds without a change after which a process hangs."""
_NO_NEW_PRIVILEGES, _SECCOMP, _SET_FILTER, _LISTENER = 38, 317, 1, 8
_RECEIVE, _SEND, _CONTINUE = 0xC0502100, 0xC0182101, 1
_PIDFD_OPEN, _PIDFD_GETFD = 434, 438
_ALLOW, _NOTIFY = 0x7FFF0000, 0x7FC00000
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass
class Outcome:
    """End of a process that was watched."""

    changes: list[str]
    """Changes that it made, in order: the call and the path."""
    killed: bool
    code: int
    """0 if it ended well."""


def watch(run: Callable[[], object], root: Path, *, last: int | None = None, torn: bool = False):
    """Run a function in a fork, killed before its change number `last` (from 0) below `root`.

    If it is `torn`, half of the bytes of that change are written; a change that is no write is not
    made. The function's own errors are printed, and the code is 1. Returns an `Outcome`.
    """
    ours, theirs = socket.socketpair()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        _become(run, theirs)
    theirs.close()
    _, (listener,), *_ = socket.recv_fds(ours, 1, 1)
    ours.close()
    try:
        return _supervise(child, listener, f"{root.resolve()}/", last, torn)
    finally:
        os.close(listener)


def _become(run: Callable[[], object], parent: socket.socket) -> None:
    """The child's whole life."""
    code = 1
    try:
        os.setsid()
        listener = _filtered()
        socket.send_fds(parent, [b"x"], [listener])
        os.close(listener)
        run()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _filtered() -> int:
    """Let the kernel ask about every call of `CALLS` from now on; where it asks."""
    load, equal, any_bit, give = 0x20, 0x15, 0x45, 0x06
    program = [(load, 0, 0, 0)]
    for number in CALLS:
        if number in _FLAGS:  # only if it creates or empties the file
            flags = 16 + 8 * _FLAGS[number]
            program += [(equal, 0, 4, number), (load, 0, 0, flags)]
            program += [(any_bit, 0, 1, os.O_CREAT | os.O_TRUNC), (give, 0, 0, _NOTIFY)]
            program += [(give, 0, 0, _ALLOW)]
        else:
            program += [(equal, 0, 1, number), (give, 0, 0, _NOTIFY)]
    program += [(give, 0, 0, _ALLOW)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in program))
    about = struct.pack("HxxxxxxQ", len(program), ctypes.addressof(code))
    _libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    listener = _libc.syscall(_SECCOMP, _SET_FILTER, _LISTENER, about)
    if listener < 0:
        raise OSError(ctypes.get_errno(), "seccomp")
    return listener


def _supervise(child: int, listener: int, root: str, last: int | None, torn: bool) -> Outcome:
    changes: list[str] = []
    killed = False
    poll = select.poll()
    poll.register(listener, select.POLLIN)
    while ready := poll.poll(1000 * PATIENCE):
        if ready[0][1] & select.POLLHUP:
            break
        asked = bytearray(80)
        try:
            fcntl.ioctl(listener, _RECEIVE, asked)
        except FileNotFoundError:  # it ended meanwhile
            continue
        number_of_call, task, _, call, _, _, *arguments = struct.unpack("QIIiIQ6Q", asked)
        change = _change(task, call, arguments, root)
        if change is not None:
            if len(changes) == last:
                if torn and call in _WRITES:
                    _tear(child, task, call, arguments)
                os.killpg(child, signal.SIGKILL)
                killed = True
                break
            changes.append(change)
        answer = bytearray(struct.pack("QqiI", number_of_call, 0, 0, _CONTINUE))
        try:
            fcntl.ioctl(listener, _SEND, answer)
        except FileNotFoundError:
            continue
    if not ready:
        os.killpg(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return Outcome(changes, killed, 0 if killed else os.waitstatus_to_exitcode(status))


def _change(task: int, call: int, arguments: list[int], root: str) -> str | None:
    """Return the path below the root that a call would change, or None."""
    name, descriptors, paths = CALLS[call]
    found = [_target(task, arguments[index]) for index in descriptors]
    for folder, path in paths:
        start = _NOWHERE if folder == _NOWHERE else ctypes.c_int32(arguments[folder]).value
        base = _target(task, start) if start >= 0 else os.readlink(f"/proc/{task}/cwd")
        found.append(os.path.normpath(os.path.join(base, _text(task, arguments[path]))))
    here = [path.removeprefix(root) for path in found if path.startswith(root)]
    if not here:
        return None
    flags = arguments[_FLAGS[call]] if call in _FLAGS else 0
    no_change = name.startswith("mkdir") or (call in _FLAGS and not flags & os.O_TRUNC)
    if no_change and os.path.lexists(found[0]):
        return None
    return " ".join([name, *here])


def _target(task: int, descriptor: int) -> str:
    try:
        return os.readlink(f"/proc/{task}/fd/{descriptor}")
    except FileNotFoundError:  # the call will fail
        return ""


def _text(task: int, address: int) -> str:
    return os.fsdecode(_memory(task, address, 4096).partition(b"\0")[0])


def _memory(task: int, address: int, most: int) -> bytes:
    """Up to so many bytes; fewer where the process has no more there."""
    with Path(f"/proc/{task}/mem").open("rb", buffering=0) as memory:
        memory.seek(address)
        page = 4096 - address % 4096
        data = memory.read(min(most, page))
        if len(data) == most or b"\0" in data:
            return data
        return data + memory.read(most - len(data))


def _tear(child: int, task: int, call: int, arguments: list[int]) -> None:
    """Write the first half of what a call would write."""
    process = _libc.syscall(_PIDFD_OPEN, child, 0)
    file = _libc.syscall(_PIDFD_GETFD, process, arguments[0], 0)
    place = _WRITES[call]
    data = bytearray()
    while len(data) < arguments[2] // 2:
        data += _memory(task, arguments[1] + len(data), arguments[2] // 2 - len(data))
    if place is None:
        os.write(file, data)
    else:
        os.pwrite(file, data, arguments[place])
    os.close(file)
    os.close(process)
