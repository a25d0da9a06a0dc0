"""Rendering of points, hands and meshes along a camera path.

Two modules satisfy `Renderer` and draw the same images: `reference` in NumPy and `jitted` in JAX.
Scenes are read and written in `state`. Sources: EgoSim, section 3.2 (rendering of the prior),
and the released `render_16fps_aligned.py`; colors and sizes of the hands are measured on the
published videos.

    Renderer, get        interface, and a renderer by name
    hand_mesh, mano      meshes of hands
    portrait, rerun_log  images and recordings of a state
"""

from __future__ import annotations

import importlib
from typing import Literal, Protocol, cast, runtime_checkable

from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from egosim_jax.rendering.mesh import MovingMesh
from egosim_jax.types import Cameras, Kind, Motion, SceneState, View

RendererName = Literal["jax", "numpy"]

PriorKind = Literal["static", "predicted"]
"""Objects in the view of a clip: at rest, or on their predicted paths."""
POINT_PX = 2
"""Default side of a drawn point in pixels, as in EgoSim's renderer."""


@runtime_checkable
class Renderer(Protocol):
    """Renderer of views and hands, such as the modules `reference` and `jitted`."""

    def render(
        self,
        state: SceneState,
        cameras: Cameras,
        *,
        point_px: int,
        motion: Motion | None = None,
    ) -> View:
        """Render a state along a camera path, with the objects on their predicted paths.

        Raises `InputError` if frame 0 shows no point.
        """
        ...

    def draw_hands(
        self, joints_m: Float[ndarray, "f n j 3"], cameras: Cameras, *, kind: Kind
    ) -> tuple[UInt8[ndarray, "f h w 3"], Float32[ndarray, "f h w"]]:
        """Draw n hands; return the image and its depth, black and infinite elsewhere."""
        ...

    def draw_mesh(
        self, mesh: MovingMesh, cameras: Cameras
    ) -> tuple[UInt8[ndarray, "f h w 3"], Float32[ndarray, "f h w"]]:
        """Draw a shaded mesh; return the image and its depth, black and infinite elsewhere."""
        ...


def get(name: RendererName) -> Renderer:
    """Return a renderer by name, imported when it is first used."""
    module = {"jax": "jitted", "numpy": "reference"}[name]
    return cast(Renderer, importlib.import_module(f"{__name__}.{module}"))
