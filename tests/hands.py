"""Painted hands and networks that detect them; each joint is a disc whose color is its index."""

import cv2
import numpy as np

from egosim_jax.perception.video.hands.litert import HandNetworks
from egosim_jax.perception.video.hands.palms import make_anchors

PALM = [0, 1, 2, 5, 9, 13, 17]
_VISIBLE, _HIDDEN = 250, 150


def hand_px(*, center, angle=0.0, size=1.0):
    """Return a hand's 21 joints around a center, turned clockwise; at 0 the fingers point up."""
    joints = [(0.0, 40.0)]
    joints += [(-14 - 9 * i, 26 - 11 * i) for i in range(4)]
    joints += [(x, 2 - 13 * i) for x in (-12, 0, 12, 24) for i in range(4)]
    joints = size * np.array(joints)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return joints @ rotation.T + np.array(center)


def paint(hands, *, right=True, hidden=(), shape=(240, 320)):
    """Return frames with the given hands; palms in `hidden` frames are not detected."""
    frames = np.zeros((len(hands), *shape, 3), np.uint8)
    for number, (frame, joints) in enumerate(zip(frames, hands, strict=True)):
        for hand in joints:
            for j, point in enumerate(hand):
                color = (
                    20 + 10 * j,
                    _HIDDEN if number in hidden else _VISIBLE,
                    250 if right else 150,
                )
                at = tuple(round(16 * v) for v in point)
                cv2.circle(frame, at, 5 * 16, color, -1, cv2.LINE_8, shift=4)
    return frames


def _joints(image):
    """Return the joints in an image, in pixels from edge to edge, or None."""
    red, green, blue = image.astype(int).transpose(2, 0, 1)
    sure = np.isin(green, (_HIDDEN, _VISIBLE)) & np.isin(blue, (150, 250))
    joints = []
    for j in range(21):
        row, column = np.nonzero(sure & (red == 20 + 10 * j))
        if not len(row):
            return None
        joints.append([column.mean() + 0.5, row.mean() + 0.5])
    return np.array(joints), green[sure].max() == _VISIBLE, blue[sure].max() == 250


class PaintedHands(HandNetworks):
    """Networks that detect one painted hand in an image."""

    def __init__(self):
        pass

    def palms(self, image):
        """Return a palm at the first anchor if the hand shows its palm."""
        boxes, logits = np.zeros((2016, 18), np.float32), np.full(2016, -50, np.float32)
        if (seen := _joints(image)) is not None and seen[1]:
            joints = seen[0]
            keypoints = joints[[0, 5, 9, 13, 17, 1, 2]] - 192 * make_anchors()[0]
            center = joints[PALM].mean(0) - 192 * make_anchors()[0]
            size = [np.ptp(joints[PALM]) / 2] * 2
            boxes[0], logits[0] = [*center, *size, *keypoints.ravel()], 4
        return boxes, logits

    def landmarks(self, image):
        """Return the joints in the image."""
        joints, presence, right = np.zeros((21, 3), np.float32), 0.0, 0.5
        if (seen := _joints(image)) is not None:
            joints[:, :2], presence, right = seen[0], 0.9, 0.95 if seen[2] else 0.05
        return joints, presence, right, np.float32(0.001) * (joints - joints[:1])
