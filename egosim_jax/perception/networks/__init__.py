"""Networks of perception, each in a worker process, so the calling process never imports torch.

Methods without weights do not belong here. Each module has both sides of one network: a frozen
dataclass of its parameters, which satisfies a Protocol of `video.estimates`, and a function
`load`, which runs in the worker and may import torch or jax. A network's `fingerprint` contains the
SHA-256 of its files but not their path: a run resumes if the folder has moved, and does not resume
with other weights.

    DepthAnything, DepthPro, DepthAnything3:                            depth
    DepthAnything3Cameras:                                              cameras
    GroundedSam2, GroundedSam3, GroundedEdgeTam, GroundingDino, Sam3:   masks and boxes
    Qwen3VL:                                                            captions
    VideoMae:                                                           video features
    NetworkError, close_workers:                                        worker processes

`worker` has both sides of the process, `checkpoint` reads folders of weights, and `closed_loop` is
the pipeline `networks`.
"""

from egosim_jax.perception.networks.depth_anything import DepthAnything
from egosim_jax.perception.networks.depth_anything_3 import DepthAnything3, DepthAnything3Cameras
from egosim_jax.perception.networks.depth_pro import DepthPro
from egosim_jax.perception.networks.grounded import GroundedEdgeTam, GroundedSam2, GroundedSam3
from egosim_jax.perception.networks.grounding_dino import GroundingDino
from egosim_jax.perception.networks.qwen3_vl import Qwen3VL
from egosim_jax.perception.networks.sam3 import Sam3
from egosim_jax.perception.networks.video_mae import VideoMae
from egosim_jax.perception.networks.worker import NetworkError, close_workers

__all__ = [
    "DepthAnything",
    "DepthAnything3",
    "DepthAnything3Cameras",
    "DepthPro",
    "GroundedEdgeTam",
    "GroundedSam2",
    "GroundedSam3",
    "GroundingDino",
    "NetworkError",
    "Qwen3VL",
    "Sam3",
    "VideoMae",
    "close_workers",
]
