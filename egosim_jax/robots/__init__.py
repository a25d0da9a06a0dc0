"""Robots in place of hands: retargeting, inverse kinematics and rendering in a clip's camera."""
