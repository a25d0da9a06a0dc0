"""The closed loop over a state, and its inputs; nothing here imports jax.

Any callable can generate, and any callable can perceive: ours are in `generation` and `perception`.

    simulator   Simulator: render, generate, perceive, fuse
    rollout     Rollout: the same, journaled and resumable
    episode     Episode: a scene and the actions in it, as files
    actions     action files and their checks
"""
