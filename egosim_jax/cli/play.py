"""`egosim play`: act in a generated world by hand, in the browser."""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.phases import phase
from egosim_jax.types import InputError, check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.interactive.env.action_spec import ActionSpec
    from egosim_jax.interactive.env.backends import GeneratedWorld
    from egosim_jax.interactive.play.viewer import LocalServer
    from egosim_jax.simulation.start import Start

HOST = "127.0.0.1"
"""Address of the page: local only, because viser has no authentication."""


@dataclass(frozen=True, kw_only=True)
class Play:
    """Act in a generated world by hand, on a page in the browser.

    Drag the hand, or let it move an object. The page shows the clip while it is decoded, next to
    the ground truth. Every clip is recorded in OUT, which `egosim data export` reads. Only this
    machine can reach the page. Needs the extra `play`. Prints the address.
    """

    out: Path = Path("runs/play")
    """Folder of the recorded sessions."""
    seed: int = 0
    """Seed of the tabletop scene."""
    episode: Path | None = None
    """Episode whose scene is used, instead of a tabletop scene."""
    hand: Literal["right", "left"] = "right"
    """Hand that acts."""
    config: str = "tabletop_student"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights; by default the shipped or fetched ones."""
    perception: str = "classical"
    """Perception pipeline, with its options (`egosim simulate --help`)."""
    update_every: Literal["clip", "chunk"] = "clip"
    """Update the state after each clip or, with a causal student, after each chunk of a clip."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    port: int = 8080
    """Port to listen on; 0 for a free one."""

    def run(self) -> int:
        """Check, load, compile, and serve the page until an interrupt."""
        if find_spec("viser") is None:
            raise InputError(
                "egosim play needs viser, which is not installed: pip install 'egosim-jax[play]'."
            )
        check_counts({"--steps": self.steps})
        check_seed(self.seed, name="--seed")
        self._check_port()
        with phase(f"loads JAX and {self.config}"):
            from egosim_jax import configs
            from egosim_jax.generation.generator import Generator
            from egosim_jax.interactive.env.action_spec import ActionSpec
            from egosim_jax.interactive.env.backends import GeneratedWorld
            from egosim_jax.interactive.play.played_episode import PlayedEpisode
            from egosim_jax.interactive.play.viewer import Page
            from egosim_jax.io.atomic import lock_folder
            from egosim_jax.io.executables import share_with_jax
            from egosim_jax.simulation.simulator import check_update_every

        share_with_jax()
        config = configs.get(self.config)
        config = replace(config, steps=self.steps or config.steps)
        check_update_every(self.update_every, config.chunk_frames, config.name, self.perception)
        weights = configs.weights_of(self.config, self.weights)
        generator = Generator.load(config, weights)
        world = GeneratedWorld(
            generator=generator,
            video=generator.config.video,
            perception=self.perception,
            trained_on=configs.trained_on(self.config, weights),
            update_every=self.update_every,
        )
        spec = ActionSpec(sides=(self.hand,), camera=True)
        with phase("makes the scene"):
            start = self._start(world, spec)
        if note := configs.scene_warning(world.trained_on, start.state.provenance):
            print(note, file=sys.stderr, flush=True)
        generator.compile(1, streamed=True)

        def begin(seed: int) -> PlayedEpisode:
            check_seed(seed, name="table")
            return PlayedEpisode(world, self.out, world.start(seed, spec), self.hand)

        with lock_folder(self.out):
            with phase("opens the page"):
                server = self._serve()
            Page(server, begin, PlayedEpisode(world, self.out, start, self.hand))
            print("ready; Ctrl-C ends it", file=sys.stderr, flush=True)
            print(f"http://127.0.0.1:{server.get_port()}", flush=True)
            _wait()
            server.stop()
        return ExitCode.DONE

    def _check_port(self) -> None:
        """Raise `InputError` for an invalid or used port; viser would choose another port."""
        if not 0 <= self.port < 1 << 16:
            raise InputError(f"--port must be from 0 to 65535, not {self.port}.")
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, self.port))
            except OSError as error:
                raise InputError(
                    f"{HOST}:{self.port} cannot be listened on ({error.strerror}): the port must "
                    "be free. Choose another one, 0 for any. (--port)"
                ) from error

    def _start(self, world: GeneratedWorld, spec: ActionSpec) -> Start:
        from egosim_jax.simulation.episode import Episode
        from egosim_jax.simulation.start import Start

        if self.episode is None:
            return world.start(self.seed, spec)
        episode = Episode.load(self.episode)
        seed = episode.state.provenance.get("seed", "")
        return Start.of(episode, seed=int(seed) if seed.isdecimal() else self.seed)

    def _serve(self) -> LocalServer:
        from egosim_jax.interactive.play.viewer import LocalServer

        with contextlib.redirect_stdout(sys.stderr):  # viser prints a banner
            return LocalServer(HOST, self.port)


def _wait() -> None:
    """Wait for Ctrl-C or SIGTERM, which end the command normally."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
