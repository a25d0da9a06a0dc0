"""`egosim play`: act in a generated world by hand, in the browser."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import tyro

from egosim_jax.interactive.options import ClipOptions
from egosim_jax.interactive.origins import bind
from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError, check_seed

if TYPE_CHECKING:
    from egosim_jax.interactive.env.action_spec import ActionSpec
    from egosim_jax.interactive.env.backends import GeneratedWorld
    from egosim_jax.interactive.play.camera_hand import CameraHand
    from egosim_jax.interactive.play.local_server import LocalServer
    from egosim_jax.interactive.play.viewer import Page
    from egosim_jax.io.shots import Shots
    from egosim_jax.perception.video.hands.litert import HandNetworks
    from egosim_jax.simulation.episode import Episode
    from egosim_jax.simulation.start import Start

MODEL = "tabletop_student"
"""Model by default."""
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
    camera: str | None = None
    """Number of a camera, such as 0, or a video in its place, to move the hand by your own one.

    Needs the extra `video`. The frames stay on this machine."""
    port: int = 8080
    """Port to listen on; 0 for a free one."""
    clips: Annotated[ClipOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ClipOptions)
    """Options of the clips."""

    def run(self) -> int:
        """Check, load, compile, and serve the page until an interrupt."""
        if find_spec("viser") is None:
            raise InputError(
                "egosim play needs viser, which is not installed: pip install 'egosim-jax[play]'."
            )
        check_seed(self.seed, name="--seed")
        bind(HOST, self.port, token=None).close()  # viser would choose another port
        with phase("loads JAX and the page"):
            from egosim_jax.interactive.env import ActionSpec, load_backend
            from egosim_jax.interactive.play.played_episode import PlayedEpisode
            from egosim_jax.interactive.play.viewer import Page
            from egosim_jax.io.atomic import lock_folder
            from egosim_jax.io.executables import share_with_jax
            from egosim_jax.simulation.episode import Episode

        watched = None if self.camera is None else self._watch(self.camera)
        share_with_jax()
        episode = None if self.episode is None else Episode.load(self.episode)
        loaded = load_backend(**vars(self.clips), default=MODEL, episode=episode)
        world = cast("GeneratedWorld", loaded)
        spec = ActionSpec(sides=(self.hand,), camera=True)
        with phase("makes the scene"):
            start = self._start(world, spec, episode)
        if note := world.note(start):
            print(printable(note), file=sys.stderr, flush=True)

        def begin(seed: int) -> PlayedEpisode:
            check_seed(seed, name="table")
            return PlayedEpisode(world, self.out, world.start(seed, spec), self.hand)

        with lock_folder(self.out):
            with phase("opens the page"):
                server = self._serve()
            page = Page(server, begin, PlayedEpisode(world, self.out, start, self.hand))
            followed = None if watched is None else self._follow(server, page, *watched)
            print("ready; Ctrl-C ends it", file=sys.stderr, flush=True)
            print(f"http://127.0.0.1:{server.get_port()}", flush=True)
            _wait()
            if followed is not None:
                followed.close()
            server.stop()
        return ExitCode.DONE

    def _watch(self, camera: str) -> tuple[Shots, HandNetworks]:
        """Open the camera, and load the networks that find a hand in its frames."""
        from egosim_jax.io.shots import Shots
        from egosim_jax.perception.video.hands.litert import HandNetworks, fetch_weights

        with phase("opens the camera"):
            networks = HandNetworks(*fetch_weights(), threads=1)
            return Shots(camera), networks

    def _follow(
        self, server: LocalServer, page: Page, shots: Shots, networks: HandNetworks
    ) -> CameraHand:
        from egosim_jax.interactive.play.camera_hand import CameraHand
        from egosim_jax.perception.video.hands.live import LiveHand

        return CameraHand(server, page, shots, LiveHand(networks, self.hand))

    def _start(self, world: GeneratedWorld, spec: ActionSpec, episode: Episode | None) -> Start:
        from egosim_jax.simulation.start import Start

        if episode is None:
            return world.start(self.seed, spec)
        seed = episode.state.provenance.get("seed", "")
        return Start.of(episode, seed=int(seed) if seed.isdecimal() else self.seed)

    def _serve(self) -> LocalServer:
        from egosim_jax.interactive.play.local_server import LocalServer

        with contextlib.redirect_stdout(sys.stderr):  # viser prints a banner
            return LocalServer(HOST, self.port)


def _wait() -> None:
    """Wait for Ctrl-C or SIGTERM, which end the command normally."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
