"""Clips from files to training batches, and imports of datasets.

Reading of single files (videos, images, weights) belongs to `io`; conditioning of a model on a clip
belongs to `conditioning`.

- metadata, clip_files, dwm: rows of a metadata file or DWM list as ClipFiles
- clips, windows, transforms: load, check and write the files of a clip; its windows; resizing
- pack, records, shards, manifest, check: clips as records in shards, and their verification
- loader, mixing: batches from shards, and weighted mixtures of shards
- moments, static: DWM's caches of latents, and checks of its conditions
- inspect, sheet: statistics and contact sheets
- readers, importing: find recordings in datasets, and import them
- recording, recorded_files, scene_points: an imported video with cameras, hands, depth and points
- lerobot_writer: simulated episodes as a LeRobot dataset
"""
