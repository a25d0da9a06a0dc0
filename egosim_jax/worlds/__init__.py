"""Procedural worlds with exact ground truth for any action.

Scenes, hand motion, contact and ray casting belong here; learned models and perception do not.

- `tabletop`: a table with a few objects, and hands or a gripper that manipulate one.
"""
