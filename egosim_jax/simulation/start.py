"""Start of a clip: scene, camera, hands and prompt, stored as a folder.

state/           scene (state/snapshot.py)
start.json       camera, row, prompt, seed, clips since the seed, kind and prompt of past actions
first_frame.png  first frame without hands, if known
past/1.npz ...   actions since the seed; the true world executes them again
past/1_hands.npz joints of all hands, if a hand of action 1 is out of view
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.bounded import quote, quote_path, read_json, refusing
from egosim_jax.io.images import read_image
from egosim_jax.simulation.actions import load_placed, save_placed
from egosim_jax.simulation.episode import MAX_CLIPS, Episode
from egosim_jax.state import snapshot
from egosim_jax.types import Action, Cameras, InputError, SceneState, VideoSpec

DESCRIPTION, FIRST_FRAME = "start.json", "first_frame.png"
FIELDS = {"world_from_camera": list, "intrinsics_px": list, "height": int, "width": int,
          "row": list, "prompt": str, "seed": int, "steps": int, "past": list}  # fmt: skip


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Start:
    """Scene, camera and hands from which the next clip continues."""

    state: SceneState
    """Scene before the next clip."""
    camera: Cameras
    """First camera of the episode; the cameras of actions are relative to it."""
    prompt: str
    """Default prompt of a clip."""
    seed: int
    """Seed of the scene; clip N draws its noise from this seed plus N."""
    steps: int = 0
    """Number of clips since the seed."""
    row: Float[np.ndarray, " d"] | None = None
    """Action row of hands and camera (`interactive/env/action_spec.py`); None at rest."""
    first_frame: UInt8[np.ndarray, "h w 3"] | None = None
    """First frame of the next clip, without hands; None if unknown."""
    past: tuple[Action, ...] = ()
    """Actions since the seed; the true world executes them first."""

    @classmethod
    def of(cls, episode: Episode, *, seed: int = 0) -> Start:
        """Return the start of an episode: its scene, first camera and first prompt."""
        first = episode.actions[0]
        cameras = first.cameras
        return cls(
            state=episode.state,
            camera=replace(
                cameras, world_from_camera=np.asarray(cameras.world_from_camera[:1], float)
            ),
            prompt=first.prompt,
            seed=seed,
            first_frame=episode.first_frame,
        )

    def after(
        self, state: SceneState, row: Float[np.ndarray, " d"], action: Action | None
    ) -> Start:
        """Return the start after a clip; the action, unless None, is appended to `past`."""
        past = self.past if action is None else (*self.past, action)
        return replace(
            self, state=state, row=row, steps=self.steps + 1, first_frame=None, past=past
        )

    def save(self, folder: Path) -> None:
        """Write the folder atomically. Raises `InputError` for more than `MAX_CLIPS` actions."""
        if len(self.past) > MAX_CLIPS:  # `load` would refuse it
            raise InputError(
                f"The start has {len(self.past)} past actions: at most {MAX_CLIPS} can be loaded. "
                "Save after fewer steps, or reset first."
            )
        with atomic_folder(folder) as temporary:
            snapshot.save(temporary / "state", self.state)
            if self.first_frame is not None:
                Image.fromarray(self.first_frame).save(temporary / FIRST_FRAME)
            for number, action in enumerate(self.past, start=1):
                save_placed(temporary / "past", str(number), action)
            description = {
                "world_from_camera": self.camera.world_from_camera[0].tolist(),
                "intrinsics_px": np.asarray(self.camera.intrinsics_px, float).tolist(),
                "height": int(self.camera.height),
                "width": int(self.camera.width),
                "row": [] if self.row is None else self.row.tolist(),
                "prompt": self.prompt,
                "seed": int(self.seed),
                "steps": int(self.steps),
                "past": [[action.kind, action.prompt] for action in self.past],
            }
            text = json.dumps(description, indent=2) + "\n"
            (temporary / DESCRIPTION).write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Start:
        """Read the folder. Raises `InputError` if it is damaged."""
        written = read_json(folder / DESCRIPTION)
        for name, kind in FIELDS.items():
            value = written.get(name) if isinstance(written, dict) else None
            if type(value) is not kind:
                raise InputError(
                    f"{quote_path(folder / DESCRIPTION)}: {name} is {quote(value)}, not a "
                    f"{kind.__name__}. Restore it."
                )
        if len(written["past"]) > MAX_CLIPS:
            raise InputError(
                f"{quote_path(folder)} has more than {MAX_CLIPS} past actions. Restore it."
            )
        with refusing(f"{quote_path(folder)} is not a readable start"):
            return cls._from(folder, written)

    @classmethod
    def _from(cls, folder: Path, written: dict[str, Any]) -> Start:
        size, image = (written["height"], written["width"]), folder / FIRST_FRAME
        return cls(
            state=snapshot.load(folder / "state"),
            camera=Cameras(
                world_from_camera=np.array(written["world_from_camera"], float)[None],
                intrinsics_px=np.array(written["intrinsics_px"], float),
                height=size[0],
                width=size[1],
            ),
            prompt=written["prompt"],
            seed=written["seed"],
            steps=written["steps"],
            row=np.array(written["row"], float) if written["row"] else None,
            first_frame=read_image(image) if image.exists() else None,
            past=tuple(
                load_placed(folder / "past", str(number), kind=kind, size=size, prompt=prompt)
                for number, (kind, prompt) in enumerate(written["past"], start=1)
            ),
        )


def check_size(start: Start, video: VideoSpec) -> None:
    """Raise `InputError` unless the start's camera has the frame size of the world."""
    camera = start.camera
    if (camera.height, camera.width) != (video.height, video.width):
        raise InputError(
            f"The episode has frames of {camera.width}x{camera.height}, this world generates "
            f"{video.width}x{video.height}: they must be equal. Make the episode for this world's "
            "model."
        )
