"""Does `classical` do worse with generated frames than with gray ones, clip by clip?

    egosim experiment continuous --out runs/continuous
    python -m tests.benchmarks.bench_gray runs/continuous [--seeds 600 ...]

Gray frames leave only the action. Each clip of `update, classical` is perceived again, from the
state that the run had before it: with its generated frames, and with gray ones. Printed is the
median distance of the moved object's points from where the world's motion of the clip brings them,
in mm, and in the end the clips in which the generated frames are worse by more than 10 mm.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax import load_state
from egosim_jax.geometry import invert, transform
from egosim_jax.perception import registry
from egosim_jax.types import Clip, SceneState
from egosim_jax.worlds.tabletop import TabletopClip, make_sequence, to_action

WORSE_MM = 10.0
"""Difference that is printed."""


def main(
    run: Annotated[Path, tyro.conf.Positional], /, seeds: tuple[int, ...] = (), clips: int = 10
) -> None:
    """Perceive the clips of a run again.

    Args:
        run: Folder of `egosim experiment continuous`.
        seeds: Seeds of the sequences; by default all of the folder.
        clips: Number of clips per sequence.
    """
    from egosim_jax import configs

    video = configs.get("tabletop").video
    found = sorted(int(path.name) for path in (run / "update_classical").iterdir())
    worse, differences = [], []
    for seed in seeds or found:
        folder = run / "update_classical" / str(seed)
        for clip in make_sequence(seed, spec=video, clips=clips):
            number = clip.number + 1
            before = folder / f"clip_{number - 1}" / "state"
            state = clip.state if number == 1 else load_state(before)
            with np.load(folder / f"clip_{number}" / "frames.npz") as arrays:
                (frames,) = arrays.values()
            generated, gray = (
                error_mm(clip, state, shown, fps=video.fps) for shown in (frames, None)
            )
            differences.append(generated - gray)
            line = f"{seed} clip {number}: generated {generated:.1f} mm, gray {gray:.1f} mm"
            print(line, flush=True)
            if generated - gray > WORSE_MM:
                worse.append(line)
    print(f"{len(differences)} clips, mean difference {np.mean(differences):.1f} mm")
    print("\n".join(worse) or f"none is worse by more than {WORSE_MM:.0f} mm")


def error_mm(
    clip: TabletopClip, state: SceneState, frames: np.ndarray | None, *, fps: float
) -> float:
    """Return the error of the moved object's place after a clip; None: gray frames."""
    if frames is None:
        frames = np.full_like(clip.frames, 127)
    action, number = to_action(clip), clip.body_ids[clip.target]
    perceived = registry.parse("classical").build()(Clip(frames=frames, fps=fps), action, state)
    points = state.points_m[state.object_ids == number].astype(float)
    path = clip.world_from_body[clip.target]
    true = transform(path[-1] @ invert(path[0]), points)
    start = state.world_from_object.get(number, np.eye(4))
    end = perceived.world_from_object.get(number)
    here = points if end is None else transform(end[-1] @ invert(start), points)
    return 1000 * float(np.median(np.linalg.norm(here - true, axis=1)))


if __name__ == "__main__":
    tyro.cli(main)
