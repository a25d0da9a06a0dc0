"""Motion of objects: what the hands predict (`dynamics`), judged by the clip.

The colors of each object on its predicted path, and at rest, are compared with the clip's. The clip
confirms the path, which is then refined (`pose_refinement`), or refutes it: the object stays unless
the hands leave no doubt. Notes report the contradiction in both cases.

A hand without a sure prediction may hold something all the same. An object with an id near
its fingertips moves with it if the clip shows that. Otherwise candidates are grown from the
points between the fingertips (`growth`), and `extent` chooses how far.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float32

from egosim_jax.dynamics import Hold, Prediction, find_holds, possible_holds
from egosim_jax.geometry import invert, transform
from egosim_jax.perception.clip.pose_refinement import Refinement, refine_pose
from egosim_jax.perception.objects.extent import choose_extent, moving_part
from egosim_jax.perception.objects.film import ColorCost, Film, ObjectModel, ObjectMotion, at_rest
from egosim_jax.perception.objects.growth import NEW, Growth, clusters_without_id
from egosim_jax.perception.pipeline import Observation
from egosim_jax.state.new_objects import next_object_id, with_objects
from egosim_jax.types import Action, Clip, InputError, SceneState, check_counts
from egosim_jax.types.arrays import Poses, Video
from egosim_jax.types.data import object_name
from egosim_jax.types.motion import Motion, ObjectPath

SURE = 0.9
"""Minimum confidence of a prediction that leaves no doubt."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A motion that one hand may cause, and what the clip says about it."""

    change: float
    """Cost of the motion less the cost at rest, and less the highest accepted one."""
    motion: ObjectMotion
    hold: Hold | None
    """Hold that only the clip shows; None if the motion is predicted."""


@dataclass(frozen=True, kw_only=True)
class TrackObjects:
    """Stage that sets motions, supporting planes and interaction frames of moved objects."""

    compared_points: int = 150
    """Approximate number of an object's points that a trial compares."""
    min_visible: float = 0.2
    """Minimum visible fraction of the compared points."""
    max_cost_ratio: float = 0.9
    """Maximum cost of a motion that is not predicted, as a fraction of the cost at rest."""
    min_improvement: float = 2.0
    """Minimum reduction of the cost at rest by such a motion, in 8-bit levels."""
    evidence: float = 8.0
    """Maximum cost of a predicted motion above the cost at rest, in 8-bit levels.

    Another motion must have a cost that is lower by as much."""
    sure_evidence: float = 90.0
    """The same if the hands leave no doubt.

    A generated clip may leave an object where the state has it, as if no hand had moved it."""
    blur_px: float = 0.7
    """Sigma of the Gaussian blur of the clip: generated frames are softer than points."""
    growth: Growth = field(default_factory=Growth)
    """Segmentation of an object without an id."""
    part: float = 0.9
    """Maximum size of a moving part, as a fraction of the whole connected cluster."""
    color: ColorCost = field(default_factory=ColorCost)
    """Comparison of the clip's colors with the predicted colors."""
    refinement: Refinement = field(
        default_factory=partial(Refinement, deviation_m=0.003, deviation_deg=5.0)
    )
    """Refinement of an object's last pose."""
    push_refinement: Refinement = field(
        default_factory=partial(Refinement, deviation_m=0.02, deviation_deg=15.0, margin=0.1)
    )
    """The same for an object that is only pushed."""

    def __post_init__(self) -> None:
        """Check that the number of points and the blur are positive."""
        check_counts({"compared_points": self.compared_points})
        if self.blur_px <= 0:
            raise InputError(f"blur_px must be positive, not {self.blur_px}.")

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `motions`, `support_planes`, `held` and `interacted_frames`.

        Pixels of hands are ignored.
        """
        cameras, joints, ids = (
            so_far.require(name, "TrackObjects") for name in ("cameras", "joints_m", "object_ids")
        )
        action = replace(action, cameras=cameras, joints_m=joints)
        shown = _smooth(clip.frames, self.blur_px)
        film = Film(cameras=cameras, shown=shown, hidden=ids < 0, color=self.color)
        prediction = Prediction.of(state, action, fps=clip.fps)
        say = partial(_sentence, action)
        search = _Search(config=self, film=film, state=state, prediction=prediction, say=say)
        motion = search.run()
        moved = search.judge(motion)
        frames = np.arange(len(clip.frames))
        held = {
            hand: number
            for hand, number in motion.held.items()
            if number in moved or number not in motion.paths
        }
        for hand, number in state.held.items():
            held.update({} if hand in prediction.tracks else {hand: number})
        new = search.new
        return replace(
            so_far,
            new_objects=new,
            names={**(so_far.names or {}), **{number: object_name(number, {}) for number in new}},
            notes=(*so_far.notes, *search.notes),
            held=held,
            motions={number: m.path for number, m in moved.items()},
            support_planes={number: m.model.plane for number, m in moved.items()},
            interacted_frames={
                number: (frames >= m.grasped) & (frames <= m.released)
                for number, m in moved.items()
            },
        )


@dataclass(kw_only=True)
class _Search:
    """Objects that the hands of a clip move, as far as they are decided."""

    config: TrackObjects
    film: Film
    state: SceneState
    prediction: Prediction
    say: Callable[[int | None, str], str]
    """Function that makes a note of what a hand did."""
    new: dict[int, Float32[np.ndarray, "n 3"]] = field(default_factory=dict)
    """Points of the state that are objects without an id, by their new ids."""
    seen: dict[int, tuple[int, Hold]] = field(default_factory=dict)
    """Objects that hands hold, and when, which only the clip shows."""
    notes: list[str] = field(default_factory=list)

    def run(self) -> Motion:
        """Return the motion of the action after a search for what its prediction lacks."""
        motion = self.prediction.motion()
        for hand in self.prediction.tracks:
            if any(_is_held(path, hand, SURE) for path in motion.paths.values()):
                continue
            with_ids = [
                candidate
                for number in self.prediction.scene.solids
                for candidate in self.candidates(self.model(number), hand, motion)
            ]
            acts = {c.hand for path in motion.paths.values() for c in path.causes}
            best = _best(with_ids) or self.without_id(hand, tell=hand not in acts)
            if best is not None and best.hold is not None:
                self.seen[hand] = best.motion.model.number, best.hold
        return self.prediction.motion(self.seen) if self.seen or self.new else motion

    def model(self, number: int) -> ObjectModel:
        """Return the model of an object."""
        return ObjectModel.of(self.state, number, self.prediction.scene.plane(number))

    def candidates(self, model: ObjectModel, hand: int, motion: Motion) -> list[Candidate]:
        """Return the accepted motions of an object with a hand: predicted, and seen in the clip."""
        path, rest = motion.paths.get(model.number), self.cost(model, at_rest(self.count))
        improvement = max(self.config.min_improvement, (1 - self.config.max_cost_ratio) * rest)
        accepted, bar = [], rest - improvement
        if path is not None:
            bar = min(bar, self.cost(model, path.motion) - self.config.evidence)
            change = self.change(model, path) - self.evidence(path)
            if change < 0 and _is_held(path, hand):
                motion_of_path = ObjectMotion.of(model, path)
                accepted.append(Candidate(change=change, motion=motion_of_path, hold=None))
        if not np.isfinite(bar):
            return accepted  # not visible
        for hold, path in self.prediction.possible_grips(hand, model.number):
            change = self.cost(model, path.motion) - bar
            if change < 0:
                motion_of_path = ObjectMotion.of(model, path)
                accepted.append(Candidate(change=change, motion=motion_of_path, hold=hold))
        return accepted

    def without_id(self, hand: int, *, tell: bool) -> Candidate | None:
        """Return the motion of points without an id that a hand moves, and make them an object.

        Without such points, notes may report why.
        """
        track, scene = self.prediction.tracks[hand], self.prediction.scene
        begins = sorted({hold.begin for hold in possible_holds(track)})
        tips = transform(invert(scene.level_from_world), track.tips_m[begins])
        clusters, note = clusters_without_id(
            tips, self.film.cameras.world_from_camera[0], self.state, self.config.growth
        )
        moved = [best for growths in clusters if (best := self.extent(growths, hand))]
        if not moved:
            closes = tell and any(hold.closes and hold.begin for hold in find_holds(track))
            if clusters:
                note = "closed on something without an id that the clip shows at rest"
            self.notes += [self.say(hand, note)] if closes else []
            return None
        best = min(moved, key=lambda candidate: candidate.change)
        model = best.motion.model
        number = next_object_id(self.state)
        self.new[number] = model.points_m.astype(np.float32)
        self.state = with_objects(self.state, self.new)
        self.prediction = self.prediction.with_object(number, model.points_m)
        note = f"moved something without an id: it is object {number} now"
        self.notes.append(self.say(hand, note))
        return replace(best, motion=replace(best.motion, model=replace(model, number=number)))

    def extent(self, growths: Sequence[ObjectModel], hand: int) -> Candidate | None:
        """Return the best motion of one of a cluster's growths."""
        moved = [best for growth in growths if (best := self.alone(growth, hand))]
        if not moved:
            return None
        mover = moving_part(moved[0].motion, self.film)
        smaller = len(mover.points_m) < self.config.part * len(growths[0].points_m)
        if smaller and len(mover.points_m) >= self.config.growth.min_points:
            moved += [best] if (best := self.alone(mover, hand)) else []
        motions = [(candidate.change, candidate.motion) for candidate in moved]
        return moved[choose_extent(motions, growths, self.film, self.state)]

    def alone(self, model: ObjectModel, hand: int) -> Candidate | None:
        """Return the best motion of points without an id."""
        trial = replace(self, prediction=self.prediction.with_object(NEW, model.points_m))
        if NEW not in trial.prediction.scene.solids:
            return None
        candidates = trial.candidates(model, hand, trial.prediction.motion())
        return _best(candidates)

    def judge(self, motion: Motion) -> dict[int, ObjectMotion]:
        """Return the motions that the clip does not refute, refined."""
        accepted = {}
        pushed = {n for n, p in motion.paths.items() if {c.how for c in p.causes} == {"pushed"}}
        for number, path in motion.paths.items():
            model, hands = self.model(number), [c.hand for c in path.causes if c.hand is not None]
            by_clip = any(self.seen.get(hand, (0,))[0] == number for hand in hands)
            change = self.change(model, path)
            name = object_name(number, self.state.names)
            what = f"{_VERBS[path.causes[0].how]} {name}"
            hand = hands[0] if hands else None
            if change > self.evidence(path) and not by_clip:
                note = f"{what}, as predicted, but the clip shows it at rest: it stays"
            elif by_clip and number not in self.new:
                note = f"may have held {name}: its fingers do not show when"
            elif change > self.config.min_improvement:
                note = f"{what}, as predicted, but the clip shows it at rest"
            else:
                note = ""
            self.notes += [self.say(hand, note)] if note else []
            if not note.endswith("it stays"):
                accepted[number] = ObjectMotion.of(model, path)
        for number in pushed & accepted.keys():
            accepted[number] = self.shortened(accepted[number])
        points = self.state.points_m.copy()
        for number, moved in accepted.items():
            chosen = self.state.object_ids == number
            points[chosen] = transform(moved.path[-1], points[chosen].astype(float))
        after = replace(self.state, points_m=points)
        certain, loose = self.config.refinement, self.config.push_refinement
        return {
            number: refine_pose(moved, self.film, after, loose if number in pushed else certain)
            for number, moved in accepted.items()
        }

    def shortened(self, moved: ObjectMotion) -> ObjectMotion:
        """Return a push that ends in the frame in which the clip shows that it does."""
        ends = range(moved.grasped + 1, self.count)
        paths = [moved.path[np.minimum(np.arange(self.count), end)] for end in reversed(ends)]
        costs = np.array([self.cost(moved.model, path) for path in paths])
        if not np.isfinite(costs).all() or costs.min() > costs[0] - self.config.min_improvement:
            return moved
        return replace(moved, path=paths[int(costs.argmin())])

    def evidence(self, path: ObjectPath) -> float:
        """Return the cost above the cost at rest from which the clip refutes a prediction."""
        sure = path.confidence >= SURE
        return self.config.sure_evidence if sure else self.config.evidence

    def change(self, model: ObjectModel, path: ObjectPath) -> float:
        """Return the cost of a path less the cost at rest, in the frames in which they differ.

        It is 0 if the object is not visible.
        """
        moved = np.flatnonzero(np.abs(path.motion - np.eye(4)).max(axis=(1, 2)) > 0)
        film = self.film.at(moved)
        change = self.cost(model, path.motion[moved], film) - self.cost(
            model, at_rest(len(moved)), film
        )
        return change if np.isfinite(change) else 0.0

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.film.shown)

    def cost(self, model: ObjectModel, path: Poses, film: Film | None = None) -> float:
        """Return the mean difference between the object's colors and the clip's on a path.

        It is infinite if too few points are visible. `film` defaults to the whole clip.
        """
        every = max(1, len(model.points_m) // self.config.compared_points)
        gaps = (film or self.film).residuals(model, path, every=every)
        seen = np.isfinite(gaps)
        if seen.sum() < self.config.min_visible * seen.size:
            return float("inf")
        return float(np.minimum(gaps[seen], self.film.color.max_residual).mean())


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the best candidate; one that only the clip shows is better than a predicted one."""
    return min(candidates, key=lambda one: (one.hold is None, one.change), default=None)


_VERBS = {
    "held": "carried", "hinged": "turned", "pushed": "pushed", "carried": "took along",
    "dropped": "dropped",
}  # fmt: skip


def _is_held(path: ObjectPath, hand: int, confidence: float = 0.0) -> bool:
    """Return True if an object is in a hand for some frames, with at least a confidence."""
    held = any(cause.hand == hand and cause.how in ("held", "hinged") for cause in path.causes)
    return held and path.confidence >= confidence


def _sentence(action: Action, hand: int | None, note: str) -> str:
    """Return a note with a hand's name: "hand 1" if several are visible, else "the hand"."""
    one = "gripper" if action.kind == "robot" else "hand"
    shown = np.isfinite(action.joints_m).all(axis=(2, 3)).any(axis=0).sum()
    return f"{one} {hand} {note}" if shown > 1 and hand is not None else f"the {one} {note}"


def _smooth(frames: Video, sigma: float) -> Float32[np.ndarray, "f h w 3"]:
    import cv2

    return np.stack([cv2.GaussianBlur(f.astype(np.float32), (0, 0), sigma) for f in frames])
