"""Commands with substitutes for what they would download: hands of a network, models of robots.

python -m tests.crash.commands COMMAND ...     as `egosim COMMAND ...`
python -m tests.crash.commands --make NAME     an input of the commands, in the current folder
"""

import sys
from pathlib import Path

from egosim_jax.annotate.config import AnnotateConfig
from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.robots import arms, models
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_episode
from tests.unit.annotate.stubs import config, textured_video, write
from tests.unit.robots.toy import TOY, make_toy


def make(name: str) -> None:
    """Write two videos, or an episode."""
    if name == "videos":
        for seed in range(2):
            write(Path(name) / f"video_{seed}.mp4", textured_video(17, seed=seed))
        return
    spec = VideoSpec(frames=5, height=32, width=48, fps=4)
    to_episode(list(make_sequence(4, spec=spec, clips=2)), fps=spec.fps).save(Path(name))


def main() -> int:
    """Run a command, or make its input."""
    if sys.argv[1] == "--make":
        make(sys.argv[2])
        return 0
    AnnotateConfig.build = lambda self: config().build()
    arms.arm_of, models.load_model = lambda _: TOY, lambda _: make_toy()
    return egosim(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
