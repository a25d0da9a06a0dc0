"""Operations on the scene state, in NumPy and Open3D: alignment, filter, fusion, storage.

No module imports jax or reads a video: `perception` does that.

    fuse        state and perceived clip to the next state
    tsdf        depth images to a surface
    filter      objects that the hands acted on
    align       reconstruction to world
    depth       initial state from one RGB-D image
    silhouettes  colors of the background next to objects
    planes      surfaces that objects stand on
    snapshot    storage as a folder; `ply` for other programs
"""
