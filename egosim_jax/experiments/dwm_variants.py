"""Models of `egosim experiment dwm`: DWM, its baselines and its ablations.

A model is described by its base, input channels, rendering of the hands and training clips. `PAPER`
has the paper's figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal, cast

import numpy as np
from jaxtyping import Float32

from egosim_jax.conditioning.layout import COGVIDEOX_INPAINT, DWM, ChannelLayout
from egosim_jax.configs.model import ModelConfig
from egosim_jax.geometry import invert, transform
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.cogvideox.motion import MotionDiTConfig
from egosim_jax.worlds.tabletop import TabletopClip

Base = Literal["inpaint", "image"]
"""Base model: CogVideoX-Fun's inpainting, or CogVideoX's image-to-video."""
Hands = Literal["mesh", "mask", "poses"]
"""Hands as shaded meshes, as their binary mask, or as joints that modulate the blocks."""
Camera = Literal["moving", "fixed"]
"""Camera of the clips: moving, as in DWM's synthetic clips, or fixed, as in its recordings."""

Cameras = tuple[tuple[Camera, float], ...]
"""Cameras of the training clips, each with its weight in the mixture."""
MOVING: Cameras = (("moving", 1.0),)
MIXED: Cameras = (("moving", 5.0), ("fixed", 2.0))
"""Mixture of moving and fixed cameras."""

SIDES, JOINTS = ("left", "right"), 21
POSE_DIM = len(SIDES) * (1 + 3 * JOINTS)
"""Number of values for the poses of both hands in a frame."""
STATIC = replace(COGVIDEOX_INPAINT, mask_packing="observed")
"""DWM without hands: 33 channels; the static scene is observed everywhere."""
IMAGE = ChannelLayout(parts=(("noisy", 16), ("prior", 16)), mask_prior=False)
"""CogVideoX's image-to-video model: 32 channels; the prior is the first frame, then black."""
IMAGE_HANDS = ChannelLayout(parts=(("noisy", 16), ("prior", 16), ("hands", 16)), mask_prior=False)
"""DWM on CogVideoX's image-to-video model: 48 channels, without a mask."""
BASES: Mapping[Base, ChannelLayout] = {"inpaint": COGVIDEOX_INPAINT, "image": IMAGE}
"""Input channels of the base models."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A model of the comparison; the default is DWM."""

    title: str
    """Name in the tables."""
    base: Base = "inpaint"
    """Base model with the initial weights."""
    layout: ChannelLayout = DWM
    """Input channels of the denoiser."""
    hands: Hands = "mesh"
    """Rendering of the hands."""
    data: Cameras = MIXED
    """Training clips."""
    poses: Literal["frame", "global"] | None = None
    """Joints that modulate a token: from its latent frame, or from all frames."""
    adapter: bool = True
    """Train a LoRA and the patch projection, not all weights."""
    trained: bool = True
    """Train the model; otherwise it is its base."""

    def model(self, config: ModelConfig, name: str) -> ModelConfig:
        """Return the model with the sizes of a config."""
        model = with_layout(config, self.layout, name)
        if self.poses is None:
            return model
        sizes = {f.name: getattr(model.dit, f.name) for f in fields(model.dit)}
        dit = MotionDiTConfig(**sizes, frames=self.poses, pose_dim=POSE_DIM)
        return replace(model, dit=dit, zero_image_tokens=model.video.frames)


def with_layout(config: ModelConfig, layout: ChannelLayout, name: str) -> ModelConfig:
    """Return a model with other input channels and another name."""
    dit = replace(cast(CogVideoXDiTConfig, config.dit), in_channels=layout.channels)
    return replace(config, name=f"{config.name}_{name}", dit=dit, layout=layout)


def poses_of(clip: TabletopClip) -> Float32[np.ndarray, "f p"]:
    """Return the joints of left and right hand in each frame's camera, in decimeters.

    Each hand has a 1 and 21 joints, or zeros if it is absent.
    """
    poses = np.zeros((len(clip.joints_m), len(SIDES), 1 + 3 * JOINTS), np.float32)
    for index, side in enumerate(clip.sides):
        place = SIDES.index(side)
        poses[:, place, 0] = 1
        for frame, world_from_camera in enumerate(clip.cameras.world_from_camera):
            local = transform(invert(world_from_camera), clip.joints_m[frame, index])
            poses[frame, place, 1:] = 10 * local.reshape(-1)
    return poses.reshape(len(poses), -1)


VARIANTS: Mapping[str, Variant] = {
    "full": Variant(title="DWM"),
    "no_hands": Variant(title="fine-tuned without hands", layout=STATIC),
    "moving_only": Variant(title="moving cameras alone", data=MOVING),
    "adaln_global": Variant(
        title="joints, all frames alike, moving alone",
        layout=STATIC,
        hands="poses",
        poses="global",
        data=MOVING,
    ),
    "adaln_frame": Variant(
        title="joints by frame, moving alone",
        layout=STATIC,
        hands="poses",
        poses="frame",
        data=MOVING,
    ),
    "hand_mask": Variant(title="hands as masks, moving alone", hands="mask", data=MOVING),
    "untrained": Variant(title="DWM, 0 updates", trained=False),
    "image_base": Variant(
        title="from the image model", base="image", layout=IMAGE_HANDS, adapter=False
    ),
    "image_untrained": Variant(
        title="from the image model, 0 updates", base="image", layout=IMAGE_HANDS, trained=False
    ),
}
"""Models by name, in order of training and display."""

Figures = Mapping[str, Mapping[str, float]]
PAPER: Mapping[str, Figures] = {
    "Table 1, synthetic, moving": {
        "sdedit": {"psnr": 19.424, "ssim": 0.675, "lpips": 0.464, "dreamsim": 0.257},
        "no_hands": {"psnr": 20.541, "ssim": 0.767, "lpips": 0.370, "dreamsim": 0.175},
        "full": {"psnr": 25.031, "ssim": 0.844, "lpips": 0.289, "dreamsim": 0.086},
    },
    "Table 1, real, fixed": {
        "sdedit": {"psnr": 16.194, "ssim": 0.586, "lpips": 0.446, "dreamsim": 0.224},
        "no_hands": {"psnr": 18.951, "ssim": 0.780, "lpips": 0.265, "dreamsim": 0.089},
        "full": {"psnr": 21.547, "ssim": 0.816, "lpips": 0.227, "dreamsim": 0.057},
    },
    "Table 2, synthetic, moving": {
        "moving_only": {"psnr": 24.151, "ssim": 0.834, "lpips": 0.304, "dreamsim": 0.093},
        "full": {"psnr": 25.031, "ssim": 0.844, "lpips": 0.289, "dreamsim": 0.086},
    },
    "Table 2, real, fixed": {
        "moving_only": {"psnr": 17.959, "ssim": 0.766, "lpips": 0.304, "dreamsim": 0.124},
        "full": {"psnr": 21.547, "ssim": 0.816, "lpips": 0.227, "dreamsim": 0.057},
    },
    "Table 3, synthetic, moving": {
        "adaln_global": {"psnr": 21.962, "ssim": 0.806, "lpips": 0.306, "dreamsim": 0.127},
        "adaln_frame": {"psnr": 22.789, "ssim": 0.827, "lpips": 0.288, "dreamsim": 0.110},
        "hand_mask": {"psnr": 22.876, "ssim": 0.797, "lpips": 0.338, "dreamsim": 0.137},
        "moving_only": {"psnr": 24.151, "ssim": 0.834, "lpips": 0.304, "dreamsim": 0.094},
    },
    "Table 4, clips not stated, at 0 and 4000 updates": {
        "image_untrained": {"dreamsim": 0.337},
        "untrained": {"dreamsim": 0.110},
        "image_base": {"dreamsim": 0.103},
        "full": {"dreamsim": 0.088},
    },
}
"""Figures of the paper by table, then by model (Kim et al. 2026)."""
