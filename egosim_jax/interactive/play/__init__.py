"""Page in the browser on which a person plays in a world (`egosim play`, extra `play`).

The session itself is in `server`, the tabletop world in `worlds`.

- `viewer`: `Page`, the viser page; `local_server`, its server; `state_cloud`, its points.
- `played_episode`: `PlayedEpisode`, the session with its ground truth and earlier moments.
- `camera_hand`: `CameraHand`, a wearer's own hand on the page, by `own_hand` (calibration, pinch),
  `foresight` (predicted objects, grasps), `recorder` (poses to paint) and `following`, all three.
- `moves`: hand paths of one clip: `drive`, `perform`, `pre_grasp_pose`, `suggest_goal`.
"""
