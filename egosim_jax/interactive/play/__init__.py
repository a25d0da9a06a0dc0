"""Page in the browser on which a person plays in a world (`egosim play`, extra `play`).

The session itself is in `server`, the tabletop world in `worlds`.

- `viewer`: `Page`, the viser page, and `LocalServer`.
- `played_episode`: `PlayedEpisode`, the session with its ground truth and earlier moments.
- `moves`: hand paths of one clip: `drive`, `perform`, `pre_grasp_pose`, `suggest_goal`.
"""
