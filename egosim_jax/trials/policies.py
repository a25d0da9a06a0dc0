"""Policies by name.

    MODULE:NAME              a function of an observation, or a class with `infer` and maybe `reset`
    openpi:HOST:PORT, ws://  a policy server that OpenPI's client can use
    exact, "never closes"    a scripted policy of the tabletop world (`worlds/tabletop/policies.py`)

A policy returns rows of actions (`interactive/env/action_spec.py`), or OpenPI's {"actions": rows}.
Several rows are the next frames; a single row is reached in a straight line over a whole clip. None
ends the trial. A class is made once for each trial that runs at the same time.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from queue import Empty, SimpleQueue
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from egosim_jax.interactive.env.action_spec import ActionSpec, to_numbers
from egosim_jax.interactive.env.chunks import straight_path
from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.runtime.registry import Registry
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop import Script
from egosim_jax.worlds.tabletop import policies as scripted

POLICIES: Registry[Any] = Registry(
    kind="policy",
    option="--policies",
    group="egosim_jax.policies",
    registered={policy.name: policy for policy in scripted.POLICIES},
)
KEY = "EGOSIM_POLICY_KEY"
"""Environment variable with the key of a policy server (openpi-client's `api_key`)."""
SENT = {"observation/image": "image", "observation/state": "row", "prompt": "prompt"}
"""Key of each part of an observation that is sent to a policy server, as for LIBERO."""
OBSERVED = ("image", "frames", "row", "keypoints", "prompt", "chunk", "seed")
"""Parts of an observation that can be sent."""
SCRIPTED = ActionSpec(layout="keypoints", workspace_m=((-0.6, -0.4, -0.1), (0.6, 0.8, 0.6)))
"""Actions of scripted policies, whose hands leave the usual workspace."""

TIMEOUT_S = 600.0
"""Maximum time in seconds that a policy server may take for a reply."""

Infer = Callable[[Mapping[str, Any]], Any]
"""Function from an observation to rows, {"actions": rows}, or None."""


class RowsError(InputError):
    """Error of actions of another kind than the run has: no trial of the policy can be made."""


class Policy:
    """Policy with its name and the layout of its actions."""

    def __init__(self, name: str, text: str, actions: ActionSpec):
        self.name, self.text, self.actions = name, text, actions

    def open(self) -> None:
        """Raise `InputError` if the policy cannot be used, before any work."""

    @contextmanager
    def agent(self, script: Script | None, seed: int) -> Iterator[Infer]:
        """Give the function of the policy for one trial."""
        raise NotImplementedError

    def first_row(self, script: Script | None, seed: int) -> Float[np.ndarray, " d"] | None:
        """Return the row in which a trial begins; None: at rest."""
        return None


class FunctionPolicy(Policy):
    """Function of an observation, called by one trial at a time."""

    def __init__(self, name: str, text: str, actions: ActionSpec, function: Infer):
        super().__init__(name, text, actions)
        self._function, self._lock = function, threading.Lock()

    @contextmanager
    def agent(self, script: Script | None, seed: int) -> Iterator[Infer]:
        """Give the function of the policy for one trial."""

        def infer(observation: Mapping[str, Any]) -> Any:
            with self._lock:
                return self._function(observation)

        yield infer


class ObjectPolicy(Policy):
    """Class with `infer`; each trial that runs at the same time has its own object."""

    def __init__(self, name: str, text: str, actions: ActionSpec, kind: Callable[[], Any]):
        super().__init__(name, text, actions)
        self._kind, self._free, self._lock = kind, SimpleQueue[Any](), threading.Lock()

    def open(self) -> None:
        """Make the first object."""
        self._free.put(self._kind())

    @contextmanager
    def agent(self, script: Script | None, seed: int) -> Iterator[Infer]:
        """Give `infer` of an object after its `reset`."""
        with self._lock:  # also the class may load a network
            try:
                policy = self._free.get_nowait()
            except Empty:
                policy = self._kind()
        try:
            if (reset := getattr(policy, "reset", None)) is not None:
                reset()
            yield policy.infer
        finally:
            self._free.put(policy)


class ServedPolicy(Policy):
    """Policy server that OpenPI's client can use; each trial has its own connection."""

    def __init__(
        self, name: str, text: str, actions: ActionSpec, sent: Mapping[str, str], wait_s: float
    ):
        super().__init__(name, text, actions)
        self._address = f"ws://{text.removeprefix('openpi:')}" if "openpi:" in text else text
        self._sent, self._wait_s = dict(sent), wait_s

    def open(self) -> None:
        """Raise `InputError` unless the server can be reached."""
        if missing := [name for name in ("websockets", "msgpack") if find_spec(name) is None]:
            raise InputError(
                f"A policy server needs {' and '.join(missing)}, not installed here: pip install "
                "'egosim-jax[serve]'. (--policies)"
            )
        try:
            with self._connection():
                pass
        except Exception as error:  # websockets has many kinds
            raise InputError(
                f"No policy server replies at {self._address}: {quote_text(str(error))}. Start it "
                "first, or wait for it by --wait. (--policies)"
            ) from error

    @contextmanager
    def _connection(self) -> Iterator[Any]:
        from egosim_jax.interactive.server import wire
        from egosim_jax.interactive.server.client import connect

        key = os.environ.get(KEY, "").strip()
        headers = {"Authorization": f"Api-Key {key}"} if key else None
        with connect(self._address, headers, wait_s=self._wait_s) as socket:
            _received(wire, socket)  # its metadata
            yield socket

    @contextmanager
    def agent(self, script: Script | None, seed: int) -> Iterator[Infer]:
        """Give a function that sends an observation and returns the reply."""
        from egosim_jax.interactive.server import wire

        with self._connection() as socket:

            def infer(observation: Mapping[str, Any]) -> Any:
                message = {key: observation[name] for key, name in self._sent.items()}
                socket.send(wire.pack(message))
                return _received(wire, socket)

            yield infer


def _received(wire: Any, socket: Any) -> Any:
    """Return the next message of a policy server; a text is the traceback of its error."""
    reply = socket.recv(timeout=TIMEOUT_S)
    if isinstance(reply, str):
        last = reply.strip().splitlines()[-1] if reply.strip() else "no message"
        raise RuntimeError(f"the policy server failed: {last}")
    return wire.unpack(reply, limit=wire.MAX_BYTES)


class ScriptedPolicy(Policy):
    """Scripted policy of the tabletop world, which carries an object in one clip."""

    def __init__(self, policy: scripted.Policy):
        super().__init__(policy.name, policy.name, SCRIPTED)
        self._policy = policy

    def _plan(self, script: Script | None, seed: int) -> Float[np.ndarray, "f d"]:
        # a scene with the task carry has a script
        joints = self._policy.plan(cast(Script, script), np.random.default_rng(seed))
        return joints.reshape(len(joints), -1)

    def refuse(self, task: str) -> None:
        """Raise `InputError` for a task that is not of the script."""
        raise InputError(
            f"The policy {self.name!r} acts out the script of a tabletop scene, so its only task "
            f"is carry, not {quote(task)}: omit the policy or the task. (--policies, --tasks)"
        )

    @contextmanager
    def agent(self, script: Script | None, seed: int) -> Iterator[Infer]:
        """Give a function that returns the plan once, and then ends the trial."""
        rows = iter([self._plan(script, seed)[1:]])
        yield lambda observation: next(rows, None)

    def first_row(self, script: Script | None, seed: int) -> Float[np.ndarray, " d"] | None:
        """Return the first row of the plan."""
        return self._plan(script, seed)[0]


@dataclass(frozen=True, kw_only=True)
class Serving:
    """Connection to policy servers."""

    sent: Mapping[str, str] = field(default_factory=lambda: dict(SENT))
    """Name of the part of an observation that each key has."""
    wait_s: float = 0.0
    """Time in seconds for which a server that does not listen yet is tried again."""


def parse(text: str, actions: ActionSpec, serving: Serving) -> Policy:
    """Return the policy of NAME=POLICY or POLICY. Raises `InputError` for any other text."""
    name, separator, spec = text.partition("=")
    if not separator or "://" in name or ":" in name:
        name, spec = text, text
    if not name.strip() or not spec:
        raise InputError(f"{quote(text)} is no policy: give POLICY or NAME=POLICY. (--policies)")
    if spec.startswith(("openpi:", "ws://", "wss://")):
        return ServedPolicy(name, spec, actions, serving.sent, serving.wait_s)
    part = POLICIES.get(spec)
    if isinstance(part, scripted.Policy):
        policy = ScriptedPolicy(part)
        policy.name = name
        return policy
    actions = getattr(part, "actions", actions)
    if not isinstance(actions, ActionSpec):
        raise InputError(
            f"The actions of {spec} are {quote(actions)}: the attribute `actions` of a policy must "
            "be an ActionSpec. (--policies)"
        )
    if isinstance(part, type) and callable(getattr(part, "infer", None)):
        return ObjectPolicy(name, spec, actions, part)
    if callable(part) and not isinstance(part, type):
        return FunctionPolicy(name, spec, actions, part)
    raise InputError(
        f"{spec} is {quote(part)}: a policy is a function of an observation, or a class with a "
        "method infer. Name the class instead of an object of it. (--policies)"
    )


def parse_all(texts: Sequence[str], actions: ActionSpec, serving: Serving) -> list[Policy]:
    """Return all policies, with different names."""
    policies = [parse(text, actions, serving) for text in texts]
    names = [policy.name for policy in policies]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(
            f"Two policies have the name {quote(twice[0])}: give each a name, such as "
            f"a={quote_text(twice[0])}. (--policies)"
        )
    return policies


def parse_sent(texts: Sequence[str], cameras: Sequence[MountedCamera] = ()) -> dict[str, str]:
    """Return the name of the part of an observation that each key of a policy server has."""
    further = [f"{camera.name}.{part}" for camera in cameras for part in ("image", "frames")]
    parts = (*OBSERVED, *further)
    sent = {}
    for text in texts:
        key, separator, name = text.rpartition("=")
        if not (separator and key and name in parts):
            raise InputError(
                f"{quote(text)} sends nothing: give KEY=PART, with one of {', '.join(parts)} as "
                "PART, such as observation/image=image. (--send)"
            )
        sent[key] = name
    return sent


def rows_of(
    reply: Any, actions: ActionSpec, before: Float[np.ndarray, " d"], frames: int
) -> Float[np.ndarray, "k d"] | None:
    """Return the rows of a policy's reply for a clip, not checked for bounds; None to end.

    More rows than a clip has frames are cut. Raises `RowsError` for rows of another length.
    """
    if isinstance(reply, Mapping):
        if "actions" not in reply:
            raise RowsError(
                f"The policy returned a map of {quote(sorted(map(str, reply)))}: it must have "
                "`actions`, rows of numbers. (--policies)"
            )
        reply = reply["actions"]
    if reply is None:
        return None
    try:
        rows, width = to_numbers(reply), len(actions.names)
    except InputError as error:
        raise RowsError(f"{error} (--policies)") from error
    if rows.ndim not in (1, 2) or rows.shape[-1] != width or not len(rows):
        raise RowsError(
            f"The policy returned actions of shape {rows.shape}: {actions.about} must have rows of "
            f"{width} numbers. Choose the actions that it was trained for (--actions, --hands), or "
            "convert them in a function of yours. (--policies)"
        )
    if rows.ndim == 1:
        return straight_path(before, rows, frames)
    return rows[: frames - 1]
