"""Annotation of recorded videos: clips with prior, mask, hands and caption, EgoSim's training data.

The estimators themselves are in `perception`; this package runs them on clips, checks the results
and writes them. Source: EgoSim, section 4 (data); the authors' networks are options.

    config       AnnotateConfig: all settings; Estimators: one per stage
    sources      find and open the videos and recordings to annotate
    frames       frame rate, size and crop of the clips of a video
    prepare      shots, windows and quality rules
    record       Record: the results of the stages for one clip, and their files
    stages       hands, silhouettes, cameras, lens, depth
    scene        scale, first frame without hands, scene state, caption, triplet
    clip         annotate one clip, resumable
    run          annotate many videos, in parallel on one machine; write the report
    cluster      annotate many clips on a Ray cluster
    gallery      HTML page of all clips
    to_episode   make an episode from an annotated clip
    lerobot_episode   make an episode from a LeRobot dataset
"""
