"""Networks of perception, each of them in a worker process, so that torch is never imported here.

A module holds one network from both sides: a frozen dataclass of its parameters, which satisfies a
Protocol of `perception.estimates`, and the function `load`, which runs in the worker and may import
torch or jax. `worker` has the processes, `checkpoint` the folders of weights, and `closed_loop` the
pipeline that is made of networks. A network's `fingerprint` has the SHA-256 of its files and not
their path: a run is resumed when the folder has moved, and refused with other weights.
"""

from egosim_jax.perception.networks.depth_anything import DepthAnything
from egosim_jax.perception.networks.depth_anything_3 import DepthAnything3, DepthAnything3Cameras
from egosim_jax.perception.networks.depth_files import DepthFiles
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
    "DepthFiles",
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
