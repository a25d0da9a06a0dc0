"""Synthetic hands of a camera: joints of hands that move in the tabletop world, and their video."""

from dataclasses import replace

import cv2
import numpy as np

from egosim_jax import configs
from egosim_jax.dynamics.hands import PALM
from egosim_jax.interactive.play.moves import pre_grasp_pose, suggest_goal
from egosim_jax.interactive.play.own_hand import FACING, OwnHand
from egosim_jax.io.writing import write_video
from egosim_jax.perception.video.hands.live import FOCAL
from egosim_jax.worlds.tabletop import start_of_sequence
from egosim_jax.worlds.tabletop.hands import frame_of, hand_meshes, joints_of, pinch
from egosim_jax.worlds.tabletop.raycast import Placed, RayCaster

RATE = 20
"""Frames per second of the camera."""
PINCHED = 0.55
"""Closure of a hand whose thumb and index finger touch."""
SIZE = 240, 320
"""Height and width of a frame of the camera."""
PLACE_M = np.array([0.03, 0.0, 0.45])
"""Palm of the hand that is held still, in the camera."""
LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation of the camera in the light, which comes from above."""


class Wearer:
    """A right hand of a person in view of a camera, moved as a hand in the workspace would."""

    def __init__(self, home, wearer, *, facing, noise=None):
        """Place the hand before a camera, or below it; `noise` draws errors of a network."""
        self._home, self._noise = home, noise
        self._world_from_camera = FACING if facing else wearer
        x = -1.0 if facing else 1.0  # the palm faces a camera in front, the back one on the head
        upright = np.array([[x, 0, 0], [0, -1.0, 0], [0, 0, -x]])
        self._at_home = cv2.Rodrigues(np.array([0.25, 0.1, 0.0]))[0] @ upright
        hand = joints_of("human", home.closure, "right")
        self._reach_m = pinch(hand)[0] - hand[PALM["human"]].mean(axis=0)

    def joints(self, pose, *, pinches=False):
        """Return the joints in the camera of a hand whose open fingertips would be at a pose."""
        world, home = self._world_from_camera, self._home
        moved = pose.point_m - home.point_m - (pose.rotation - home.rotation) @ self._reach_m
        turn = world.T @ pose.rotation @ home.rotation.T @ world
        local = joints_of("human", PINCHED if pinches else home.closure, "right")
        local = local - local[PALM["human"]].mean(axis=0)
        joints = local @ (turn @ self._at_home).T + PLACE_M + world.T @ moved
        if self._noise is not None:
            joints = joints + self._noise.normal(0, 0.0015, joints.shape)
            joints = joints * np.exp(self._noise.normal(0, 0.004))
        return joints


def way(home, grip, goal_m, *, still_s=1.5, slowness=1.0):
    """Return poses and pinches at the camera's rate: calibrate, grasp, carry to a goal, release."""
    above, there = np.array([0, -0.02, 0.08]), np.asarray(goal_m)
    stops = [
        (home.point_m, still_s, False),
        (grip + above, 1.0, False),
        (grip, 0.8, False),
        (grip, 0.5, True),
        ((grip + there) / 2 + [0, 0, 0.08], 0.8, True),
        (there, 0.8, True),
        (there, 0.5, False),
        (there + above, 0.5, False),
        (home.point_m, 0.8, False),
    ]
    moments, point = [], home.point_m
    for stop, seconds, pinches in stops:
        steps = round(slowness * seconds * RATE)
        for number in range(1, steps + 1):
            at = point + number / steps * (stop - point)
            moments.append((replace(home, point_m=at), pinches))
        point = stop
    return moments


def film_of_carry(path, seed):
    """Write the video of a hand that carries the suggested object to a place, as in a mirror."""
    scene, camera, *_ = start_of_sequence(seed, spec=configs.get("tabletop").video)
    name, goal = suggest_goal(scene, "right")
    wearer = camera.world_from_camera[0, :3, :3]
    home = OwnHand("right", wearer).home
    person = Wearer(home, wearer, facing=True)
    grip = pre_grasp_pose(scene, name, "right").point_m
    moments = way(home, grip, [*goal, grip[2] + 0.01], still_s=6, slowness=1.3)
    film(path, [person.joints(pose, pinches=pinches) for pose, pinches in moments])


def film(path, joints):
    """Write the video of a camera that sees every other one of the hands with these joints."""
    frames, joints = {}, joints[::2]
    for hand in joints:
        if hand.tobytes() not in frames:
            frames[hand.tobytes()] = _render(hand)
    write_video(path, np.stack([frames[hand.tobytes()] for hand in joints]), RATE // 2)


def _render(joints):
    """Return the frame of a camera with a hand before a wall."""
    (height, width), axes = SIZE, frame_of(joints, "human")[:3, :3]
    parts = hand_meshes(joints, joints[0] - 0.3 * axes[:, 1], "human", axes[:, 2])
    pose = np.eye(4)
    pose[:3, :3] = LEVEL
    placed = [
        Placed(part=part, world_from_part=pose, instance_id=number)
        for number, part in enumerate(parts, start=1)
    ]
    focal = FOCAL * width
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    frame = RayCaster(placed).render(pose, intrinsics, height=height, width=width)
    return np.where(frame.ids[..., None] == 0, np.uint8([150, 160, 170]), frame.colors)
