"""Names of the arrays that many functions take; `types` explains the letters of their shapes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

Video = UInt8[np.ndarray, "f h w 3"]
"""Frames in RGB."""
RgbImage = UInt8[np.ndarray, "h w 3"]
"""One image in RGB."""
Masks = Bool[np.ndarray, "f h w"]
"""Pixels of each frame."""
Mask = Bool[np.ndarray, "h w"]
"""Pixels of one image."""
Pose = Float[np.ndarray, "4 4"]
"""Rigid transform in meters."""
Poses = Float[np.ndarray, "f 4 4"]
"""Rigid transform of each frame, in meters."""
Matrix = Float[np.ndarray, "3 3"]
"""Rotation, or intrinsics in pixels."""
Vector = Float[np.ndarray, " 3"]
"""Point or direction."""
Plane = Float[np.ndarray, " 4"]
"""Plane a x + b y + c z + d = 0."""
Points = Float[np.ndarray, "n 3"]
"""Points in meters."""
DepthMap = Float[np.ndarray, "h w"]
"""Depth of each pixel along the camera's z axis, in meters or in the unit of the cameras."""
DepthMaps = Float32[np.ndarray, "f h w"]
"""The same of each frame."""
IdMaps = Int32[np.ndarray, "f h w"]
"""Object instance of each pixel of each frame."""
Colors = Float32[np.ndarray, "n 3"]
"""Colors in RGB, in 8-bit levels."""
