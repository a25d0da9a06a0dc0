"""Robots in place of hands: retargeting, inverse kinematics and rendering in a clip's camera.

Arms:

- arms, models: the table of arms, and their MuJoCo models
- description, toml: described robots that are not in the table
- own, urdf, checks, own_report: loading and checking their models

Clips with hands:

- sources, conversion: clips with robots in place of hands
- retarget, placement, ik: grips, a base, and joint positions
- background, drawing: frames without hands, and robots in them

Recordings:

- recorded, first_scene: joints of LeRobot datasets as actions, and their scene
"""
