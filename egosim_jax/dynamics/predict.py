"""Prediction of the motion of a state's objects, from cameras, hands and points alone.

    motion = predict(state, action, fps=8)

The frames are walked through once. In each one, held objects follow their hands, hands and objects
push others, objects on moving ones ride along, and released objects fall.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from egosim_jax.dynamics.grips import (
    SIGMAS,
    Contact,
    Hold,
    closes_on,
    contact_of,
    find_holds,
    first_hold,
    hand_motion,
    hinge_motion,
    is_along_edge,
    is_grip,
    possible_holds,
)
from egosim_jax.dynamics.hands import HandTrack, track_hand
from egosim_jax.dynamics.level import LevelScene, level_scene, to_world
from egosim_jax.dynamics.pushes import push
from egosim_jax.dynamics.solids import Solid, make_solid
from egosim_jax.dynamics.support import UP, carry_riders, fall, furniture, next_to, raised, release
from egosim_jax.dynamics.walk import Grip, Walk
from egosim_jax.geometry import invert, rotation_angles_deg, transform
from egosim_jax.types import Action, SceneState
from egosim_jax.types.arrays import Points, Pose, Poses, Vector
from egosim_jax.types.motion import Cause, How, Motion, ObjectPath

REACH_M = 0.25
"""Distance around the hands' paths within which objects are considered, in meters."""
MIN_MOTION_M, MIN_TURN_DEG = 0.002, 2.0
"""Motion up to which an object rests, in meters and degrees."""
NEAR_M = 0.06
"""Maximum distance of a fingertip from an object that the hand may hold, in meters."""
FAR_M = {"held": 0.03, "pushed": 0.06}
"""Motion in meters by exact hands that is beyond doubt: the object would be in their way."""
SURE, LIKELY = 0.95, 0.7
"""Confidence in such a motion, and in any other."""
LOOK_AHEAD = 2
"""Frames in which a noisy hand may get a better grip of the same object."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Hands and objects of an action in level coordinates, from which motions follow."""

    scene: LevelScene
    """Objects within reach of the hands."""
    tracks: Mapping[int, HandTrack]
    """Track of each hand that is in view."""
    held_before: Mapping[int, int]
    """Object that each hand held before the first frame."""
    first: Mapping[int, Solid]
    """Objects that have moved since the first state, where they were there."""
    fps: int
    """Frames per second."""

    @classmethod
    def of(cls, state: SceneState, action: Action, *, fps: int = 8) -> Prediction:
        """Read the hands of an action and the objects of a state. Points without an id rest."""
        tracks = _tracks(action)
        reached = [track.joints_m.reshape(-1, 3) for track in tracks.values()]
        points_m = np.concatenate([np.zeros((0, 3)), *reached])
        camera = action.cameras.world_from_camera[0]
        return cls.without_hands(state, camera, points_m, fps=fps)._with(tracks)

    @classmethod
    def without_hands(
        cls, state: SceneState, world_from_camera: Pose, points_m: Points, *, fps: int
    ) -> Prediction:
        """Read the objects of a state within reach of some points; `with_hands` adds hands."""
        scene = level_scene(state, world_from_camera, points_m, reach_m=REACH_M)
        return cls(
            scene=scene,
            tracks={},
            held_before=state.held,
            first=_first_solids(scene, state.world_from_object),
            fps=fps,
        )

    def with_hands(self, action: Action) -> Prediction:
        """Return the prediction of another action, whose hands reach no other objects."""
        return self._with(_tracks(action))

    def _with(self, tracks: Mapping[int, HandTrack]) -> Prediction:
        level = {hand: _in_level(track, self.scene) for hand, track in tracks.items()}
        return replace(self, tracks=level)

    @cached_property
    def furniture(self) -> frozenset[int]:
        """Objects that are parts of one piece of furniture, now or in the first state."""
        solids = self.scene.solids
        return frozenset(furniture(solids) | furniture({**solids, **self.first}))

    def with_object(self, number: int, points_m: Points) -> Prediction:
        """Return the prediction with one more object, which has no id in the state."""
        return replace(self, scene=self.scene.with_object(number, points_m))

    def motion(self, grips: Mapping[int, tuple[int, Hold]] | None = None) -> Motion:
        """Return the motion of the objects that the hands cause.

        `grips` are objects that hands hold, and when, in place of what their fingers say.
        """
        given, solids = grips or {}, self.scene.solids
        if not self.tracks or not solids:
            return Motion()
        walk = Walk(
            solids=solids,
            tracks=self.tracks,
            holds={
                hand: [given[hand][1]] if hand in given else self._holds(hand, track)
                for hand, track in self.tracks.items()
            },
            given={hand: number for hand, (number, _) in given.items()},
            held_before=self.held_before,
            ground_m=self.scene.ground_m,
            furniture=set(self.furniture),
        )
        for frame in range(len(next(iter(self.tracks.values())).present)):
            if frame:
                _carry(walk)
                push(walk)
                fall(walk, self.fps)
            _release(walk)
            _grasp(walk)
            walk.next_frame()
        return _motion(walk, self.scene)

    def _holds(self, hand: int, track: HandTrack) -> list[Hold]:
        """Return the possible holds of a hand, which may begin with what it held before."""
        held_on = self.held_before.get(hand) in self.scene.solids and track.present[0]
        return [*([first_hold(track)] if held_on and track.sigma_m else []), *find_holds(track)]

    def possible_grips(self, hand: int, number: int) -> Iterator[tuple[Hold, ObjectPath]]:
        """Yield the holds in which a hand near an object may carry it, each with the path so far.

        The path ends with the hold: nothing falls.
        """
        solid, track = self.scene.solids[number], self.tracks[hand]
        for hold in possible_holds(track):
            tips = track.tips_m[hold.begin]
            if solid.distance(tips, np.eye(4)).min() > NEAR_M:
                continue
            motion, how = _coupling(track, hold, tips.mean(axis=0), solid, np.eye(4))
            cause = Cause(how=how, hand=hand, begin=hold.begin, end=hold.end)
            yield (
                hold,
                ObjectPath(motion=to_world(self.scene, motion), causes=(cause,), confidence=0.0),
            )


def predict(state: SceneState, action: Action, *, fps: int = 8) -> Motion:
    """Return the motion of the objects of a state that an action causes.

    `fps` is the rate of the action's frames. Points without an id do not move.
    """
    return Prediction.of(state, action, fps=fps).motion()


def _tracks(action: Action) -> dict[int, HandTrack]:
    """Return the track of each hand of an action that is in view."""
    return {
        hand: track
        for hand in range(action.joints_m.shape[1])
        if (track := track_hand(np.asarray(action.joints_m[:, hand], float), action.kind))
    }


def _in_level(track: HandTrack, scene: LevelScene) -> HandTrack:
    """Return a track in level coordinates."""
    level = scene.level_from_world
    return replace(
        track,
        joints_m=transform(level[None], track.joints_m),
        tips_m=transform(level[None], track.tips_m),
        center_m=transform(level, track.center_m),
        rotation=level[:3, :3] @ track.rotation,
    )


def _first_solids(scene: LevelScene, poses: Mapping[int, Pose]) -> dict[int, Solid]:
    """Return the objects that have moved as they stood in the first state."""
    level, solids = scene.level_from_world, {}
    for number in poses.keys() & scene.solids.keys():
        back = level @ invert(poses[number]) @ invert(level)
        points = transform(back, scene.solids[number].points_m)
        base = float(points[:, 2].min())
        solids[number] = make_solid(number, points, base_m=base, eye_m=scene.eye_m)
    return {number: solid for number, solid in solids.items() if solid is not None}


def _motion(walk: Walk, scene: LevelScene) -> Motion:
    """Return the paths of the objects that moved, and what the hands hold at the end."""
    paths = {}
    for number, poses in walk.paths.items():
        motion = np.stack(poses)
        center = walk.solids[number].center_m[None]
        moved = np.linalg.norm(transform(motion, center)[:, 0] - center, axis=1).max()
        if moved > MIN_MOTION_M or rotation_angles_deg(motion).max() > MIN_TURN_DEG:
            hands = {cause.hand for cause in walk.causes[number]} - {None}
            kind = "pushed" if {c.how for c in walk.causes[number]} == {"pushed"} else "held"
            exact = not any(walk.tracks[hand].sigma_m for hand in hands if hand is not None)
            paths[number] = ObjectPath(
                motion=to_world(scene, motion),
                causes=tuple(walk.causes[number]),
                confidence=SURE if exact and moved >= FAR_M[kind] else LIKELY,
            )
    held = {
        hand: number
        for hand, track in walk.tracks.items()
        for number, solid in walk.solids.items()
        if closes_on(track, solid, walk.poses[number])
    }
    return Motion(
        paths=paths, held={**held, **{hand: grip.number for hand, grip in walk.grips.items()}}
    )


def _carry(walk: Walk) -> None:
    """Move held objects, and the objects on them, with their hands."""
    for hand, grip in walk.grips.items():
        pose = grip.motion[walk.frame] @ grip.start
        if grip.how == "held":
            above = raised(walk, grip.number, pose)
            sigma_m = walk.tracks[hand].sigma_m
            if sigma_m and above[2, 3] - pose[2, 3] > SIGMAS * sigma_m:  # the hand left it there
                walk.grips[hand] = grip.ending(walk.frame)
                continue
            pose = above
        carry_riders(walk, grip.number, pose, grip.hand)
        walk.move(grip.number, pose, grip.how, grip.hand)


def _release(walk: Walk) -> None:
    """Release the objects of hands whose hold ends in this frame, before the clip does."""
    for hand, grip in list(walk.grips.items()):
        if grip.hold.end != walk.frame or not grip.hold.opens:
            continue
        del walk.grips[hand]
        walk.left.add((hand, grip.number))
        joints = walk.tracks[hand].joints_m.shape[1]
        walk.pressing |= {(hand, joint, grip.number) for joint in range(joints)}
        if grip.how == "held":
            release(walk, grip.number)


def _grasp(walk: Walk) -> None:
    """Give each hand whose hold begins in this frame the object that it grips, if there is one.

    Of two hands on an object, the one with the deeper pinch point gets it.
    """
    offers = []
    for hand in walk.tracks.keys() - walk.grips.keys():
        hold = _hold_from(walk, hand, walk.frame)
        gripped = None if hold is None else _gripped(walk, hand, hold)
        if hold is not None and gripped is not None:
            offers.append((hand, hold, *gripped))
    for hand, hold, number, contact in sorted(offers, key=lambda offer: -offer[3].depth_m):
        if number in walk.in_hands:
            walk.left.add((hand, number))  # it is around the object, and does not push it
            continue
        track, pinch = walk.tracks[hand], contact.pinch_m
        start = walk.poses[number]
        motion, how = _coupling(track, hold, pinch, walk.solids[number], start)
        walk.grips[hand] = Grip(
            hand=hand, number=number, hold=hold, motion=motion, how=how, start=start
        )
        if how == "hinged":
            walk.furniture |= {number, *next_to(walk, number)}
        walk.falls.pop(number, None)
        walk.note(number, how, hand, walk.frame, hold.end)


def _coupling(
    track: HandTrack, hold: Hold, pinch_m: Vector, solid: Solid, start: Pose
) -> tuple[Poses, How]:
    """Return the motion of an object in a hand, about a hinge if the hand describes its arc."""
    motion = hinge_motion(track, hold)
    if motion is not None and is_along_edge(transform(start, solid.points_m), motion[-1]):
        return motion, "hinged"
    return hand_motion(track, hold, pinch_m, UP), "held"


def _hold_from(walk: Walk, hand: int, frame: int) -> Hold | None:
    return next((hold for hold in walk.holds[hand] if hold.begin == frame), None)


def _gripped(walk: Walk, hand: int, hold: Hold) -> tuple[int, Contact] | None:
    """Return the object that a hand grips in a hold, and the contact.

    It is the object in which the pinch point is deepest. A hand that does not close grips what it
    held before, or what it is around in the first frame. A noisy hand waits for its best frame.
    """
    track, contacts = walk.tracks[hand], {}
    certain = walk.given.get(hand)
    if hold.begin == 0 and track.sigma_m:
        certain = walk.held_before.get(hand, certain)
    if certain is not None and certain in walk.solids:
        pinch = track.pinch_m[hold.begin]
        return certain, Contact(pinch_m=pinch, depth_m=float("inf"), gap_m=0.0)
    for number, solid in walk.solids.items():
        if number in walk.in_hands or (hand, number) in walk.left:
            continue
        contact = contact_of(solid, walk.poses[number], track, hold)
        first = hold.begin == 0 and walk.held_before.get(hand, number) == number
        if contact is not None and (first or is_grip(contact, track, hold)):
            contacts[number] = contact
    if not contacts:
        return None
    number = max(contacts, key=lambda number: contacts[number].depth_m)
    for frame in range(hold.begin + 1, hold.begin + 1 + LOOK_AHEAD) if track.sigma_m else ():
        later = _hold_from(walk, hand, frame)
        better = later and contact_of(walk.solids[number], walk.poses[number], track, later)
        if later and better and better.depth_m > contacts[number].depth_m:
            return None
    return number, contacts[number]
