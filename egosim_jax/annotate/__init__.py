"""Annotation of recorded videos: clips with prior, mask, hands and caption, as EgoSim trains on.

    prepare      shots and windows of a video, its quality, frames at the size of the clips
    stages       hands, silhouettes, cameras, depth, scale, plate, state, prior, skeletons, caption
    run          many videos: journaled, in parallel, on one machine or on a Ray cluster

A folder of annotations is in the layout of `data/metadata.py`, and each clip has what was estimated
along with it. Source: EgoSim, section 4 (data); the authors' networks are options.
"""
