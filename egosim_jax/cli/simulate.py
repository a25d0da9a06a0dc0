"""`egosim simulate`: generate clips in sequence; each changes the scene state of the next."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.rendering import RendererName
from egosim_jax.rendering.portrait import write_portrait
from egosim_jax.rendering.rerun_log import RECORDING, Recording
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import counted, print_line, printable
from egosim_jax.simulation import preview
from egosim_jax.simulation.changes import MovedObject, moved_objects
from egosim_jax.state.planes import vertical
from egosim_jax.types import InputError, Kind, VideoSpec, check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.simulation.episode import Episode
    from egosim_jax.simulation.simulator import Simulator, Step
    from egosim_jax.types import Action, GroundTruth, SceneState
    from egosim_jax.worlds.tabletop import TabletopClip

SHEET_FRAMES = 6
"""Number of frames of each video on a contact sheet."""
MODEL = "tabletop"
"""Model by default."""
CLIPS = 3
"""Default number of clips in the tabletop world."""


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Act several times in a scene that keeps its changes: an episode, or the tabletop world.

    Each clip is generated from a view of the scene state; perception then updates the state from
    the clip. Writes clip_N.mp4 and clip_N_cmp.mp4 (view | hands | generated | ground truth) for
    each clip; state_N.ply and state_N.png before the first clip and after each; contact_sheet.png;
    report.json; and, if Rerun is installed, simulation.rrd for `egosim view`. Clips are scored if
    the episode has ground truth, as in the tabletop world. The same command resumes an interrupted
    run.
    """

    help_groups: ClassVar[HelpGroups] = {
        "scene": ("robot", "first_frame"),
        "loop": ("weights", "steps", "perception", "update", "update_every", "renderer"),
    }
    config: str | None = None
    """Name of the model (`egosim models list`), or preview, which needs no weights.

    By default tabletop, or a preview of a scene that is not of the tabletop world."""
    episode: Path | None = None
    """Folder or .zip of an episode (`egosim episode make`); by default the tabletop world."""
    clips: int | None = None
    """Number of clips; by default all of the episode, or 3 in the tabletop world."""
    seed: int = 0
    """Seed of the noise, and of scene and actions in the tabletop world."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    perception: str = "classical"
    """Perception pipeline, with its options: classical, networks, recorded, oracle or MODULE:NAME.

    MODULE:NAME is a pipeline of your own. 'NAME --help' lists the options of a pipeline."""
    update: Literal["full", "none"] = "full"
    """Update the state, or keep the initial state."""
    update_every: Literal["clip", "chunk"] = "clip"
    """Update the state after each clip or, with a causal student, after each chunk of a clip."""
    renderer: RendererName = "jax"
    """Renderer of the view and the hands; numpy is the slow reference."""
    robot: bool = False
    """Use a robot gripper instead of human hands in the tabletop world."""
    first_frame: Path | None = None
    """Image for the first frame of the first clip; by default the episode's."""
    out: Path | None = None
    """Folder to write to; by default runs/simulate_SEED."""
    weights: Path | None = None
    """Folder of weights; by default the shipped or fetched ones."""

    def run(self) -> int:
        """Simulate; write videos, states and scores."""
        check_counts({"--clips": self.clips, "--steps": self.steps})
        check_seed(self.seed)
        if self.update == "none" and self.perception != Simulate.perception:
            raise InputError(
                f"--perception {self.perception} has no effect with --update none: give --update "
                "full, or omit this option."
            )
        with phase(f"loads JAX and {self.config or MODEL}"):
            from egosim_jax import rendering
            from egosim_jax.evaluation.metrics.loop import DEFINITIONS
            from egosim_jax.generation.choose import choose
            from egosim_jax.generation.generator import Generator
            from egosim_jax.io.digest import fingerprint
            from egosim_jax.io.executables import share_with_jax
            from egosim_jax.io.journal import Journal
            from egosim_jax.io.run import open_folder, write_json
            from egosim_jax.perception import registry
            from egosim_jax.perception.recorded import RecordedConfig
            from egosim_jax.simulation.rollout import OUTPUTS, Rollout
            from egosim_jax.simulation.simulator import Simulator, check_update_every

        share_with_jax()
        given = self._given()
        maker = choose(
            self.config,
            self.weights,
            default=MODEL,
            steps=self.steps,
            provenance=given and given.state.provenance,
            video=given and given.video,
        )
        check_update_every(self.update_every, maker.chunk_frames, maker.name, self.perception)
        folder = self.out or Path("runs") / f"simulate_{self.seed}"
        pipeline = registry.parse(self.perception) if self.update == "full" else None
        reads = pipeline is not None and registry.reads_ground_truth(pipeline)
        if given is not None:
            check_fits(given, maker.video, maker.name)
        episode = self._chosen(given or self._made(maker.video, with_ground_truth=reads))
        perception = None
        if pipeline is not None:
            if isinstance(pipeline, RecordedConfig):
                pipeline.check_clips(len(episode.actions))
            perception = pipeline.build(episode.observations())
        made_of = {
            "simulate": replace(self, config=maker.name),
            **maker.made_of,
            "episode": fingerprint(episode),
        }
        journal = Journal(folder, outputs=OUTPUTS)  # a damaged one is refused before the weights
        free = ["simulate.weights", "simulate.first_frame", "simulate.episode"]
        open_folder(folder, made_of, mutable=free)
        count = len(episode.actions)
        clips = counted(count, "clip")
        print(printable(f"{folder}: {clips} by {maker.name}"), file=sys.stderr, flush=True)
        if note := maker.note(episode.state.provenance):
            print(printable(note), file=sys.stderr, flush=True)
        outputs = _Outputs(folder, episode, name=maker.name)
        generator = maker.load(renderer=rendering.get(self.renderer))
        if isinstance(generator, Generator) and f"{count} generate" not in journal.done:
            generator.compile(1, streamed=True)
        simulator = Simulator(
            show=outputs.show,
            generator=generator,
            perception=perception,
            fps=maker.video.fps,
            update_every=self.update_every,
        )
        steps = Rollout(simulator, folder).run(
            episode.state, episode.actions, seed=self.seed, first_frame=episode.first_frame
        )
        truths = self._ground_truth(episode, maker.video)
        report = outputs.write(simulator, steps, truths)
        notes = [note] if note else []
        about = {"definitions": DEFINITIONS, "model": maker.name, "notes": notes, "clips": report}
        write_json(folder / "report.json", about)
        if self.episode is None or episode.ground_truth:
            _print(report, name=maker.name)
        print_line(folder / "contact_sheet.png")
        return ExitCode.DONE

    def _given(self) -> Episode | None:
        """Return the given episode; None for the tabletop world."""
        from egosim_jax.simulation.episode import Episode

        if self.episode is None:
            return None
        if self.robot:
            raise InputError("--robot is for the tabletop world: an episode has its own hands.")
        with phase(f"loads {self.episode}"):
            return Episode.load(self.episode)

    def _made(self, video: VideoSpec, *, with_ground_truth: bool) -> Episode:
        """Return an episode of the tabletop world.

        Ground truth is rendered only on request; `_ground_truth` renders it clip by clip.
        """
        from egosim_jax.worlds.tabletop import episode_of_sequence, to_episode

        with phase("makes the tabletop scene"):
            if with_ground_truth:
                return to_episode(list(self._rendered(video)), fps=video.fps)
            count, kind = self.clips or CLIPS, self._kind
            return episode_of_sequence(self.seed, spec=video, clips=count, kind=kind)

    def _chosen(self, episode: Episode) -> Episode:
        """Return an episode with the chosen clips and first frame."""
        if self.clips is not None and self.clips > len(episode.actions):
            raise InputError(
                f"{self.episode} has {len(episode.actions)} clips, not {self.clips}. (--clips)"
            )
        count = self.clips or len(episode.actions)
        episode = replace(
            episode,
            actions=episode.actions[:count],
            ground_truth=episode.ground_truth[:count],
        )
        if self.first_frame is None:
            return episode
        from egosim_jax.io.images import read_image

        image, (_, height, width) = read_image(self.first_frame), episode.shape
        if image.shape != (height, width, 3):
            raise InputError(
                f"{self.first_frame} is {image.shape}, the clips are {(height, width, 3)}. "
                "(--first-frame)"
            )
        return replace(episode, first_frame=image)

    @property
    def _kind(self) -> Kind:
        return "robot" if self.robot else "human"

    def _rendered(self, video: VideoSpec) -> Iterator[TabletopClip]:
        """Yield the clips of the tabletop world, each rendered when it is asked for."""
        from egosim_jax.worlds.tabletop import make_sequence

        count, kind = self.clips or CLIPS, self._kind
        return make_sequence(self.seed, spec=video, clips=count, kind=kind)

    def _ground_truth(
        self, episode: Episode, video: VideoSpec
    ) -> Iterable[GroundTruth] | Iterable[None]:
        """Return the ground truth of each clip, as far as it is known."""
        from egosim_jax.worlds.tabletop import ground_truth_of

        if self.episode is None and not episode.ground_truth:
            return map(ground_truth_of, self._rendered(video))
        return episode.ground_truth or (None,) * len(episode.actions)


def check_fits(episode: Episode, video: VideoSpec, config: str) -> None:
    """Raise `InputError` unless an episode has the length, size and rate of a model's clips."""
    frames, height, width = episode.shape
    of_episode = f"{frames} frames of {width}x{height} at {episode.fps} fps"
    model = f"{video.frames} of {video.width}x{video.height} at {video.fps} fps"
    shape = (*episode.shape, episode.fps)
    if shape != (video.frames, video.height, video.width, video.fps):
        from egosim_jax import configs

        videos = {name: configs.get(name).video for name in configs.names()}
        fitting = [n for n, v in videos.items() if shape == (v.frames, v.height, v.width, v.fps)]
        others = f"Models of such clips: {', '.join(fitting)}. " if fitting else ""
        raise InputError(
            f"The episode has clips of {of_episode}, and {config} generates {model}: they must be "
            f"equal. {others}Choose another model, or preview, which makes any clips (--config), "
            "or make the episode for this one."
        )


def sheet_moments(frames: int) -> list[int]:
    """Return the evenly spaced frames of a video that a contact sheet shows."""
    return [(frames - 1) * k // (SHEET_FRAMES - 1) for k in range(SHEET_FRAMES)]


@dataclass
class _Outputs:
    """Writer of a simulation's videos, states, contact sheet and recording."""

    folder: Path
    episode: Episode
    name: str
    """Name of the model, or "preview"."""
    number: int = 1
    """Number of the clip in progress."""
    shown: list[np.ndarray] = field(default_factory=list)
    """Frames of the clip in progress, in groups."""

    @property
    def _label(self) -> str:
        """Label of the clips among other videos."""
        return preview.NAME if self.name == preview.NAME else "generated"

    @cached_property
    def up(self) -> Float[np.ndarray, " 3"]:
        """Direction that points up in the world."""
        first = self.episode.actions[0].cameras.world_from_camera[0]
        return vertical(self.episode.state, first)

    def show(self, frames: np.ndarray) -> None:
        """Write the video of a clip once its last frame is decoded, before it is perceived."""
        self.shown.append(frames)
        if sum(map(len, self.shown)) == self.episode.shape[0]:
            self._write_clip(np.concatenate(self.shown))

    def _write_clip(self, frames: np.ndarray) -> None:
        from egosim_jax.io.writing import write_video

        path = self.folder / f"clip_{self.number}.mp4"
        write_video(path, frames, self.episode.fps)
        print_line(path)

    def write(
        self, simulator: Simulator, steps: Iterator[Step], truths: Iterable[GroundTruth | None]
    ) -> list[dict[str, Any]]:
        """Write every step; return the report, one entry per clip."""
        folder, state = self.folder, self.episode.state
        recording = None
        report, sheet = [], []
        then = time.monotonic()
        for step, action, truth in zip(steps, self.episode.actions, truths, strict=True):
            if not self.shown:  # the clip was made before an interrupt
                self._write_clip(step.clip.frames)
            if self.number == 1:  # not before: the first clip would have to wait
                self._write_state(0, state)
                if find_spec("rerun"):
                    recording = Recording(folder / RECORDING, folder.name, up=self.up)
            moved = moved_objects(state, step.state, step.notes)
            with phase(f"clip {self.number}: scores and draws", only_if_long=True):
                report.append(
                    {
                        "clip": self.number,
                        "action": action.prompt,
                        "notes": list(step.notes),
                        "moved": [asdict(change) for change in moved],
                        **({} if step.latency is None else asdict(step.latency)),
                        **_score(simulator, step, action, truth),
                    }
                )
                sheet.append(self._write_step(simulator, step, action, truth))
            if recording is not None:
                recording.add(
                    state,
                    action,
                    view=step.view.frames,
                    frames=step.clip.frames,
                    ground_truth=truth and truth.frames,
                )
            self._print_step(step, action, moved, seconds=time.monotonic() - then)
            state = step.state
            self.number, self.shown, then = self.number + 1, [], time.monotonic()
        if recording is not None:
            recording.close(state)
        moments = sheet_moments(self.episode.shape[0])
        draw_sheet(sheet, folder / "contact_sheet.png", moments=moments)
        return report

    def _print_step(
        self, step: Step, action: Action, moved: Sequence[MovedObject], *, seconds: float
    ) -> None:
        about = f"clip {self.number}/{len(self.episode.actions)}: {action.prompt}"
        times = f"{seconds:.1f} s"
        if not self.shown:
            times = "made before"
        elif step.latency is not None:
            first, last = step.latency.first_frame_s, step.latency.last_frame_s
            times += f"; first frame after {first:.1f} s, last after {last:.1f} s"
        print(printable(f"{about} ({times})"), file=sys.stderr)
        for line in (*step.notes, *moved):
            print(printable(f"  {line}"), file=sys.stderr)

    def _write_step(
        self, simulator: Simulator, step: Step, action: Action, truth: GroundTruth | None
    ) -> SheetClip:
        """Write videos and state of one step; return its part of the contact sheet."""
        from egosim_jax.io.writing import write_video

        hands = simulator.renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[0]
        videos = {"view": step.view.frames, "hands": hands, self._label: step.clip.frames}
        if truth is not None:
            videos["ground truth"] = truth.frames
        side_by_side = np.concatenate(list(videos.values()), axis=2)
        write_video(self.folder / f"clip_{self.number}_cmp.mp4", side_by_side, step.clip.fps)
        self._write_state(self.number, step.state)
        return SheetClip(
            f"{self.number}: {action.prompt}   ({', '.join(videos)})", list(videos.values())
        )

    def _write_state(self, number: int, state: SceneState) -> None:
        from egosim_jax.state.snapshot import write_ply

        write_ply(self.folder / f"state_{number}.ply", state)
        write_portrait(self.folder / f"state_{number}.png", state, up=self.up)


def _score(
    simulator: Simulator, step: Step, action: Action, truth: GroundTruth | None
) -> dict[str, float]:
    if truth is None:
        return {}
    from egosim_jax.evaluation.metrics.loop import score_step

    return score_step(
        step.clip.frames,
        truth,
        cameras=action.cameras,
        before=step.view,
        after=simulator.render(step.state, action),
    )


def _print(report: Sequence[Mapping[str, Any]], *, name: str) -> None:
    from egosim_jax.evaluation.metrics.loop import MEASURES
    from egosim_jax.evaluation.metrics.report import print_table

    scored = {name for line in report for name in line}
    shown = {name: measure for name, measure in MEASURES.items() if name in scored}
    rows = {
        f"{line['clip']}: {line['action']}": {
            name: {"mean": line[name]} for name in shown if name in line
        }
        for line in report
    }
    warning = f"{name}s, not clips of a model; " if name == preview.NAME else ""
    print_table("clip", rows, shown, caption=f"{warning}report.json defines these measures")
