"""`egosim simulate`: several clips in a row, each in the world that the last one left."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from egosim_jax.cli.recording import Recording
from egosim_jax.cli.view import RECORDING, write_portrait
from egosim_jax.command import DONE
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.rendering import RendererName
from egosim_jax.types import InputError, check_counts, check_seed

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.perception import Perception
    from egosim_jax.simulator import Step
    from egosim_jax.types import SceneState
    from egosim_jax.worlds.tabletop import TabletopClip

SHEET_MOMENTS = (0, 3, 6, 9, 12, 16)


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Act several times in a scene of the tabletop world, which remembers what was done.

    Each clip is generated from a view of the state, read back, and fused into it. Writes for each
    clip clip_N.mp4 and clip_N_cmp.mp4 (view | hands | generated | truth), the state before the
    first and after each as state_N.ply and state_N.png, contact_sheet.png, report.json and, if
    Rerun is installed, simulation.rrd for `egosim view`. An interrupted run goes on where it
    stopped.
    """

    config: str = "tabletop"
    """Name of the model."""
    clips: int = 3
    """How many."""
    seed: int = 0
    """Of the scene, what is done in it, and the noise."""
    perception: str = "classical"
    """Perception pipeline and its options: classical (no network weights), oracle (ground truth),
    or another registered one."""
    update: Literal["full", "none"] = "full"
    """Whether the state learns from the clips, or stays as it was before the first."""
    renderer: RendererName = "jax"
    """Renderer of the view and the hands; numpy is the slow reference."""
    robot: bool = False
    """The hands are a robot's gripper."""
    first_frame: Path | None = None
    """Image that the first clip begins with; else the scene without hands."""
    out: Path | None = None
    """Folder to write to; runs/simulate_SEED if not given."""
    weights: Path | None = None
    """Folder of weights, if not those that come with the package."""

    def run(self) -> int:
        """Simulate, measure, draw."""
        from egosim_jax import configs, rendering
        from egosim_jax.generator import Generator
        from egosim_jax.io.digest import sha256
        from egosim_jax.io.run import open_folder, write_json
        from egosim_jax.io.weights import hashes
        from egosim_jax.rollout import Rollout
        from egosim_jax.simulator import Simulator
        from egosim_jax.worlds.tabletop import make_sequence, to_action

        check_counts({"--clips": self.clips})
        check_seed(self.seed)
        config = configs.get(self.config)
        weights = configs.weights_of(self.config, self.weights)
        folder = self.out or Path("runs") / f"simulate_{self.seed}"
        made_of = {
            "simulate": self,
            "model": config,
            "weights": hashes(weights),
            "image": None if self.first_frame is None else sha256(self.first_frame),
        }
        open_folder(folder, made_of, mutable=["simulate.weights", "simulate.first_frame"])
        kind = "robot" if self.robot else "human"
        truth = list(make_sequence(self.seed, spec=config.video, clips=self.clips, kind=kind))
        simulator = Simulator(
            generator=Generator.load(config, weights, renderer=rendering.get(self.renderer)),
            perception=None if self.update == "none" else backend(self.perception, truth),
            fps=config.video.fps,
        )
        steps = Rollout(simulator, folder).run(
            truth[0].state,
            [to_action(clip) for clip in truth],
            seed=self.seed,
            first_frame=self._image(truth[0]),
        )
        recording = Recording(folder / RECORDING, folder.name) if find_spec("rerun") else None
        state, report, blocks = truth[0].state, [], []
        _write_state(folder, 0, state)
        then = time.monotonic()
        for clip, step in zip(truth, steps, strict=True):
            report.append({"clip": clip.number + 1, "action": clip.caption, **score(step, clip)})
            blocks.append(_write(folder, clip, step))
            if recording is not None:
                recording.add(state, to_action(clip), step, clip.frames)
            state = step.state
            print(folder / f"clip_{clip.number + 1}.mp4")
            print(
                f"clip {clip.number + 1}/{self.clips}: {clip.caption} "
                f"({time.monotonic() - then:.1f} s)",
                file=sys.stderr,
            )
            then = time.monotonic()
        if recording is not None:
            recording.close(state)
        write_json(folder / "report.json", {"definitions": DEFINITIONS, "clips": report})
        draw_sheet(blocks, folder / "contact_sheet.png", moments=SHEET_MOMENTS)
        _print(report)
        print(folder / "contact_sheet.png")
        return DONE

    def _image(self, clip: TabletopClip) -> np.ndarray:
        if self.first_frame is None:
            return clip.first.colors
        from egosim_jax.io.video import read_image

        image = read_image(self.first_frame)
        if image.shape != clip.first.colors.shape:
            raise InputError(
                f"{self.first_frame} is {image.shape}, the clips are {clip.first.colors.shape}. "
                "(--first-frame)"
            )
        return image


def backend(perception: str, clips: Sequence[TabletopClip]) -> Perception:
    """Return the perception of that name and options, for a sequence with ground truth."""
    from egosim_jax.perception import registry
    from egosim_jax.worlds.tabletop import to_ground_truth

    ground_truth = {clip.number: to_ground_truth(clip) for clip in clips}
    return registry.parse(perception).build(ground_truth)


MEASURES = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "region_psnr": ("region PSNR dB", "{:.2f}"),
    "prior_psnr": ("PSNR of the view dB", "{:.2f}"),
    "depth_error": ("depth error %", "{:.2f}"),
    "camera_error": ("camera error mm", "{:.1f}"),
}
DEFINITIONS = {
    "psnr, ssim": "of the generated clip against the true one, without frame 0, as in evaluate",
    "region_psnr": "the same over the pixels where the truth shows a hand or the thing acted on",
    "prior_psnr": "of the view of the state, copied, against the true clip",
    "depth_error": "mean |depth - truth| / truth in percent: the state after the clip, seen from "
    "the clip's last camera, against the true depth there, without hands",
    "camera_error": "root mean square distance in mm between where the generated frames were seen "
    "from (flow from the true frames, PnP with their depth) and the true cameras",
}


def score(step: Step, clip: TabletopClip) -> dict[str, float]:
    """Every measure of one step."""
    import numpy as np

    from egosim_jax.metrics.depth import coverage, depth_error
    from egosim_jax.metrics.region import region_psnr
    from egosim_jax.metrics.report import score as compare
    from egosim_jax.rendering.reference import render
    from egosim_jax.worlds.tabletop.scene import FIRST_HAND

    video, truth, ids = step.clip.frames[1:], clip.frames[1:], clip.ids
    whole = compare(video, truth)
    acted = (ids >= FIRST_HAND) | (ids == clip.body_ids[clip.target])
    after = render(step.state, clip.cameras, point_px=2)
    bare = np.zeros_like(acted)
    bare[-1] = ids[-1] < FIRST_HAND
    return {
        **whole,
        "region_psnr": region_psnr(video, truth, acted[1:]),
        "prior_psnr": compare(step.view.frames[1:], truth)["psnr"],
        "depth_error": depth_error(after.depth_m, clip.depth_m, bare),
        "depth_known": coverage(after.depth_m, bare),
        "camera_error": _camera_error(step.clip.frames, clip, ~acted),
    }


def _camera_error(frames: np.ndarray, clip: TabletopClip, still: np.ndarray) -> float:
    from egosim_jax.metrics.trajectory import camera_errors, estimate_cameras

    path = estimate_cameras(frames, clip.frames, clip.depth_m, still, clip.cameras)
    return 1000 * camera_errors(path, clip.cameras.world_from_camera)[0]


def _write(folder: Path, clip: TabletopClip, step: Step) -> SheetClip:
    """The videos and the state of one step; its part of the contact sheet."""
    import numpy as np

    from egosim_jax.io.video import write_video
    from egosim_jax.rendering.reference import draw_hands

    hands = draw_hands(clip.joints_m, clip.cameras, kind=clip.kind)[0]
    shown = [step.view.frames, hands, step.clip.frames, clip.frames]
    name = f"clip_{clip.number + 1}"
    write_video(folder / f"{name}.mp4", step.clip.frames, step.clip.fps)
    write_video(folder / f"{name}_cmp.mp4", np.concatenate(shown, axis=2), step.clip.fps)
    _write_state(folder, clip.number + 1, step.state)
    return SheetClip(f"{clip.number + 1}: {clip.caption}   (view, hands, generated, truth)", shown)


def _write_state(folder: Path, number: int, state: SceneState) -> None:
    from egosim_jax.state.snapshot import write_ply

    write_ply(folder / f"state_{number}.ply", state)
    write_portrait(folder / f"state_{number}.png", state, up="z")


def _print(report: Sequence[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("clip", "action", *(name for name, _ in MEASURES.values()))
    for line in report:
        cells = [form.format(line[name]) for name, (_, form) in MEASURES.items()]
        table.add_row(str(line["clip"]), line["action"], *cells)
    Console(width=160).print(table)
