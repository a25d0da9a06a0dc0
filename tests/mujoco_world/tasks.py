"""24 tasks of the MuJoCo world, and the place of every solid in one of them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tests.mujoco_world.solids import SOLIDS, Solid, Texture

Deed = Literal["carry", "turn", "hold", "push"]
COLORS = (
    (200, 60, 50), (50, 90, 190), (60, 150, 70), (230, 180, 50), (240, 235, 220), (60, 60, 70),
    (150, 80, 160), (220, 130, 60), (90, 190, 200), (150, 110, 80),
)  # fmt: skip
PATTERNS = ("plain", "checks", "stripes", "spots")
GAP_M = 0.02
"""Least distance between solids that do not touch, in meters."""
TABLE_M = ((-0.19, 0.19), (-0.07, 0.2))
"""Ranges of x and y on the table of the solids, in view of the camera."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A deed of the gripper with one solid, and the solids next to it."""

    solid: str
    deed: Deed = "carry"
    """Carry and put down; the same with a turn; carry and hold; or push with closed jaws."""
    behind: str = ""
    """Solid that touches it on the far side."""
    below: str = ""
    """Solid below it."""
    onto: str = ""
    """Solid on which it is put down."""
    frames: int = 17


TASKS = (
    Task(solid="box"),
    Task(solid="can"),
    Task(solid="sphere"),
    Task(solid="capsule", frames=9),
    Task(solid="ellipsoid"),
    Task(solid="mug"),
    Task(solid="bowl"),
    Task(solid="bottle"),
    Task(solid="L"),
    Task(solid="hexagon", frames=13),
    Task(solid="wedge"),
    Task(solid="frustum", onto="book"),
    Task(solid="box", behind="brick"),
    Task(solid="can", behind="box"),
    Task(solid="mug", behind="book"),
    Task(solid="cube", below="brick"),
    Task(solid="tin", below="book"),
    Task(solid="card"),
    Task(solid="pen"),
    Task(solid="plate", frames=13),
    Task(solid="crate", deed="push"),
    Task(solid="tin", deed="push"),
    Task(solid="brick", deed="turn"),
    Task(solid="bottle", deed="hold"),
)


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A solid at its start."""

    name: str
    solid: Solid
    texture: Texture
    place_m: np.ndarray
    """Its origin, in meters."""
    yaw: float
    """Rotation about z in radians."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The solids of a scene; the gripper moves the first to the goal."""

    task: Task
    placed: tuple[Placed, ...]
    goal_m: np.ndarray
    goal_yaw: float


def make_layout(seed: int) -> Layout:
    """Return the scene of a seed: its task is the seed modulo 24, the rest is drawn."""
    task, rng = TASKS[seed % len(TASKS)], np.random.default_rng(seed)
    while (layout := _draw(task, rng)) is None:
        pass
    return layout


def _draw(task: Task, rng: np.random.Generator) -> Layout | None:
    """Return a layout, or None if its random places do not fit."""
    yaw = rng.uniform(-0.35, 0.35)
    target = SOLIDS[task.solid]()
    start = np.array([rng.uniform(-0.13, 0.13), rng.uniform(-0.04, 0.1), 0.0])
    placed: list[Placed] = []

    def put(name: str, place_m: np.ndarray, turn: float) -> None:
        solid, texture = SOLIDS[name](), _texture(rng)
        placed.append(Placed(name=name, solid=solid, texture=texture, place_m=place_m, yaw=turn))

    if task.below:
        start[2] = SOLIDS[task.below]().height_m
    put(task.solid, start, yaw)
    if task.below:
        put(task.below, start * [1, 1, 0], yaw)
    taken = [(start[:2], max(p.solid.reach_m for p in placed))]
    if task.behind:
        other = SOLIDS[task.behind]()
        apart = target.half_depth_m + other.half_depth_m + 5e-4
        place = start + apart * np.array([-np.sin(yaw), np.cos(yaw), 0])
        put(task.behind, place, yaw)
        taken.append((place[:2], other.reach_m))
    goal, goal_yaw = _goal(task, target, start, yaw, taken, rng)
    if goal is None:
        return None
    if task.onto:
        put(task.onto, goal * [1, 1, 0], yaw)
    taken.append((goal[:2], max(target.reach_m, placed[-1].solid.reach_m if task.onto else 0)))
    if task.deed == "push":  # a free way
        taken += [(start[:2] + t * (goal - start)[:2], target.reach_m) for t in (0.33, 0.67)]
    for name in rng.permutation(sorted(set(SOLIDS) - {"crate", "pen", "card", task.solid})):
        reach = SOLIDS[name]().reach_m
        for _ in range(30):
            place = np.array([rng.uniform(*TABLE_M[0]), rng.uniform(*TABLE_M[1]), 0.0])
            if _is_free(place, reach, taken):
                put(str(name), place, rng.uniform(-np.pi, np.pi))
                taken.append((place[:2], reach))
                break
        if len(placed) >= 4:
            break
    return Layout(task=task, placed=tuple(placed), goal_m=goal, goal_yaw=goal_yaw)


def _goal(
    task: Task,
    target: Solid,
    start: np.ndarray,
    yaw: float,
    taken: list[tuple[np.ndarray, float]],
    rng: np.random.Generator,
) -> tuple[np.ndarray | None, float]:
    """Return a goal in view that is free, and the turn there; None if none is found."""
    turn = yaw + (rng.choice([-1, 1]) * rng.uniform(0.5, 0.8) if task.deed == "turn" else 0)
    for _ in range(50):
        length = rng.uniform(0.08, 0.11) if task.deed == "push" else rng.uniform(0.1, 0.2)
        angle = np.pi / 2 + yaw if task.deed == "push" else rng.uniform(0, 2 * np.pi)
        goal = start * [1, 1, 0] + length * np.array([np.cos(angle), np.sin(angle), 0])
        inside = all(a <= v <= b for v, (a, b) in zip(goal, TABLE_M, strict=False))
        reach = max(target.reach_m, SOLIDS[task.onto]().reach_m if task.onto else 0)
        if inside and (task.deed == "push" or _is_free(goal, reach, taken)):
            goal[2] = SOLIDS[task.onto]().height_m if task.onto else 0
            return goal, turn
    return None, turn


def _is_free(place: np.ndarray, reach: float, taken: list[tuple[np.ndarray, float]]) -> bool:
    return all(np.linalg.norm(place[:2] - p) >= reach + r + GAP_M for p, r in taken)


def _texture(rng: np.random.Generator) -> Texture:
    first, second = rng.choice(len(COLORS), 2, replace=False)
    return Texture(
        colors=(COLORS[first], COLORS[second]),
        pattern=PATTERNS[rng.integers(len(PATTERNS))],
        period_m=rng.uniform(0.018, 0.035),
        phase=rng.uniform(0, 6, 3),
    )
