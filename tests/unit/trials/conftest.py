"""Policies for trials, and a small true world."""

import numpy as np
import pytest

from egosim_jax.interactive.env import ActionSpec
from egosim_jax.interactive.env.rewards import Reward
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.trials import policies
from egosim_jax.types import VideoSpec

VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)


def still(observation):
    """Stay where the hands are."""
    return observation["row"]


def forward(observation):
    """Move ahead by 2 cm in each clip."""
    return {"actions": observation["row"] + [0, 0.02, 0, 0, 0, 0, 0]}


def outside(observation):
    """Leave the workspace."""
    return observation["row"] + 9


def crashes(observation):
    """Raise an error of the policy."""
    raise ZeroDivisionError("of the policy")


def narrow(observation):
    """Return rows that are too short."""
    return np.zeros((3, 5))


class Counting:
    """Two clips, then the end; each trial begins again."""

    resets = 0

    def reset(self):
        """Begin a trial."""
        type(self).resets += 1
        self.left = 2

    def infer(self, observation):
        """Return rows, twice."""
        self.left -= 1
        return None if self.left < 0 else np.repeat(observation["row"][None], 3, axis=0)


def bright(outcome):
    """Judge a clip by its pixels, and the state by its first one."""
    frames = outcome.step.clip.frames
    seen = outcome.step.view.frames.shape == frames.shape
    return Reward(reward=float(frames.mean()), success=bool(seen and frames.mean() > 10))


def no_dataset(root, number, video):
    """Read no dataset."""
    raise AssertionError


@pytest.fixture
def world():
    return TrueWorld(video=VIDEO)


def policy(text):
    """A policy of this module or a scripted one."""
    name = f"{__name__}:{text}" if text in globals() else text
    return policies.parse(f"{text}={name}", ActionSpec(), policies.Serving())
