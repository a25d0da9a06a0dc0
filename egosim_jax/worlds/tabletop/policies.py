"""Scripted policies of the tabletop world with faults of graded size.

Each policy carries a body to a goal. Its belief may be wrong: the positions of body and goal have
normally distributed errors, or it takes another body. Its hand may also open too early, or never
close.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from egosim_jax.worlds.tabletop import hand_motion
from egosim_jax.worlds.tabletop.bodies import Body
from egosim_jax.worlds.tabletop.sequence import Script

MAX_ERROR_M = (0.03, 0.02)
"""Maximum horizontal and vertical distance to the goal that counts as success, in meters."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """A policy that carries a body, with its faults."""

    name: str
    """Name in tables."""
    grasp_m: float = 0.0
    """Standard deviation of the believed body position, along x and y, in meters."""
    goal_m: float = 0.0
    """Standard deviation of the believed goal position, along x and y, in meters."""
    release: float = 1.0
    """Fraction of the carrying time after which the hand opens."""
    wrong: float = 0.0
    """Probability that the policy takes another body."""
    grasps: bool = True
    """False: the hand never closes."""

    def plan(self, script: Script, rng: np.random.Generator) -> Float[np.ndarray, "f 1 j 3"]:
        """Return the joints of the acting hand in meters; the script must carry a body."""
        # Every policy draws the same number of values. Equal generators then give all policies the
        # same errors, in units of their standard deviations.
        errors, chance, choice = rng.normal(size=(2, 2)), rng.random(), rng.random()
        scene, hand, intent = script.scene, script.moments[0].hands[0], script.intent
        others = [
            b for b in scene.bodies if not (b.static or b.articulated or b.name == intent.name)
        ]
        if chance < self.wrong and others:
            intent = replace(intent, name=others[int(choice * len(others))].name)
        pose = scene.body(intent.name).world_from_body.copy()
        pose[:2, 3] += self.grasp_m * errors[0]
        goal = np.asarray(intent.goal_m, float) + [*(self.goal_m * errors[1]), 0.0]
        believed, intent = scene.with_pose(intent.name, pose), replace(intent, goal_m=goal)
        frames, kind = len(script.moments), script.kind
        moments = hand_motion.act(believed, (hand,), intent, kind, frames=frames)
        begin, end = hand_motion.holding(believed, hand, intent, kind)
        begin -= hand_motion.CLOSE_SHARE
        opens = begin if not self.grasps else begin + self.release * (end - begin)
        times, wide = np.linspace(0, 1, frames), hand_motion.opened(kind)
        hands = [
            hand.with_closure(min(hand.grip.closure, wide))
            if time >= opens and opens < end
            else hand
            for hand, time in zip((m.hands[0] for m in moments), times, strict=True)
        ]
        return np.array([[h.grip.pose(kind, h.side)[0]] for h in hands])


POLICIES = (
    Policy(name="exact"),
    Policy(name="grasp off by 1 cm", grasp_m=0.01),
    Policy(name="grasp off by 2 cm", grasp_m=0.02),
    Policy(name="grasp off by 4 cm", grasp_m=0.04),
    Policy(name="goal off by 2.5 cm", goal_m=0.025),
    Policy(name="goal off by 5 cm", goal_m=0.05),
    Policy(name="opens after 65 %", release=0.65),
    Policy(name="opens after 50 %", release=0.5),
    Policy(name="wrong body in half", wrong=0.5),
    Policy(name="never closes", grasps=False),
)
"""Policies of the ranking experiment, and of attempts."""


def goal_error_m(body: Body, goal_m: Float[np.ndarray, " 3"]) -> tuple[float, float]:
    """Return the horizontal and the vertical distance of a body's origin to its goal."""
    gap = body.world_from_body[:3, 3] - goal_m
    return float(np.hypot(gap[0], gap[1])), abs(float(gap[2]))


def succeeded(error_m: tuple[float, float]) -> bool:
    """Return whether a horizontal and a vertical distance to the goal count as success."""
    return error_m[0] <= MAX_ERROR_M[0] and error_m[1] <= MAX_ERROR_M[1]
