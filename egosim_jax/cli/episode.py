"""`egosim episode`: make, check and show episodes, the inputs of `egosim simulate`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from egosim_jax.rendering import RendererName
from egosim_jax.runtime.command import ExitCode, Writes, group
from egosim_jax.runtime.terminal import counted, print_line
from egosim_jax.types import InputError, check_counts, check_seed, object_name

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.data.sheet import SheetClip
    from egosim_jax.simulation import episode as episodes
    from egosim_jax.types import Action, SceneState


@dataclass(frozen=True, kw_only=True)
class MakeEpisode:
    """Make an episode of the tabletop world, or of your own cameras, hands and scene.

    Without --actions, the seed determines scene and actions, and the episode has ground truth.
    With --actions, give one .npz or .json file per clip, in meters and OpenCV axes:
    world_from_camera (f, 4, 4), intrinsics_px (3, 3), joints_m (f, hands, 21 or 3, 3), null or NaN
    where a hand is missing. Intrinsics are in pixels of the clips: scale them with the video. A
    .json file may also have a prompt. Give the scene by --state, or by --image (without hands) and
    --depth, both seen from the first camera. An image of another shape than the clips is cropped.
    Objects can move: --objects finds them in the image, and their names and sizes are printed.
    """

    writes: ClassVar[Writes] = "folder or .zip file"
    out: Path
    """Folder to write, or a file whose name ends in .zip."""
    config: str = "tabletop"
    """Model whose length, size and frame rate the clips have."""
    seed: int | None = None
    """Seed of scene and actions in the tabletop world; by default 0."""
    clips: int | None = None
    """Number of clips in the tabletop world; by default 3."""
    robot: bool = False
    """Use a robot gripper instead of human hands in the tabletop world."""
    actions: tuple[Path, ...] = ()
    """Files of your own cameras and hand joints, one per clip."""
    prompts: tuple[str, ...] = ()
    """Prompt of each clip, instead of those in the files."""
    state: Path | None = None
    """Folder of a state, or a .ply of colored points."""
    image: Path | None = None
    """Image of the scene without hands, from the first camera, at any resolution."""
    depth: Path | None = None
    """Depth of the image in meters: an .npz file with the array depth_m."""
    objects: str | None = None
    """Movable objects of the image: auto, none, FILE or NETWORK=FOLDER; by default auto.

    auto: what stands on a table, shelf or floor. FILE: a .png of the image's size with an object
    id per pixel, 0 for the background. NETWORK: see --masks of `egosim data annotate`."""
    names: tuple[str, ...] = ()
    """Names of objects, each ID=NAME; by default "object 1" and so on."""
    detector: Path | None = None
    """Folder of Grounding DINO, for networks whose name begins with grounded."""
    phrases: tuple[str, ...] = ()
    """Names of the objects that a network segments."""

    def run(self) -> int:
        """Make, check and write the episode."""
        check_counts({"--clips": self.clips})
        check_seed(self.seed or 0)
        if not self.actions:
            return save_episode(self._tabletop(), self.out)
        return save_episode(self._own(), self.out, describe=True)

    def _tabletop(self) -> episodes.Episode:
        from egosim_jax import configs
        from egosim_jax.worlds.tabletop import make_sequence, to_episode

        of_scene = ("prompts", "state", "image", "depth", "objects", "names", "detector", "phrases")
        if given := [name for name in of_scene if getattr(self, name)]:
            raise InputError(f"--{given[0]} needs --actions: the tabletop world makes its own.")
        video = configs.get(self.config).video
        kind = "robot" if self.robot else "human"
        seed, count = self.seed or 0, self.clips or 3
        clips = list(make_sequence(seed, spec=video, clips=count, kind=kind))
        return to_episode(clips, fps=video.fps)

    def _own(self) -> episodes.Episode:
        from egosim_jax import configs
        from egosim_jax.cli.simulate import check_fits
        from egosim_jax.simulation.actions import read_action
        from egosim_jax.simulation.episode import Episode

        given = {"clips": self.clips, "seed": self.seed, "robot": self.robot or None}
        if names := [name for name, value in given.items() if value is not None]:
            raise InputError(
                f"--{names[0]} is for the tabletop world: the files of --actions have their own "
                f"clips and hands. Remove --{names[0]} or --actions."
            )
        if self.prompts and len(self.prompts) != len(self.actions):
            raise InputError(
                f"{len(self.prompts)} prompts for {len(self.actions)} files: give one per clip. "
                "(--prompts)"
            )
        video = configs.get(self.config).video
        prompts = self.prompts or (None,) * len(self.actions)
        actions = tuple(
            read_action(path, height=video.height, width=video.width, prompt=prompt)
            for path, prompt in zip(self.actions, prompts, strict=True)
        )
        state, image = self._scene(actions)
        episode = Episode(state=state, actions=actions, fps=video.fps, first_frame=image)
        check_fits(episode, video, self.config)
        return episode

    def _scene(self, actions: Sequence[Action]) -> tuple[SceneState, np.ndarray | None]:
        """Return the state, and the image, if given, at the size of the clips."""
        from egosim_jax.data.crop import plan_crop
        from egosim_jax.io.images import read_image

        frame, cameras = None, actions[0].cameras
        if self.image is not None:
            image = read_image(self.image)
            crop = plan_crop(
                image.shape[:2],
                (cameras.height, cameras.width),
                name=str(self.image),
                fix="Crop the image, or turn it, as the clips are. (--image)",
            )
            frame = crop.resample(image)
            if self.depth is not None and self.state is None:
                intrinsics = crop.source_intrinsics(cameras.intrinsics_px)
                return self._lift(image, self.depth, intrinsics, actions), frame
        if given := [n for n in ("objects", "names", "detector", "phrases") if getattr(self, n)]:
            raise InputError(
                f"--{given[0]} needs --image and --depth: the state of --state has its own objects."
            )
        if self.state is not None and self.depth is None:
            return read_state(self.state), frame
        raise InputError("The scene must be given once: by --state, or by --image and --depth.")

    def _lift(
        self, image: np.ndarray, depth: Path, intrinsics: np.ndarray, actions: Sequence[Action]
    ) -> SceneState:
        """Return the points of an RGB-D image taken by the first camera."""
        import numpy as np

        from egosim_jax.cli.objects import names_of, objects_of
        from egosim_jax.geometry import invert, transform
        from egosim_jax.io.untrusted.npz import read_arrays
        from egosim_jax.perception.video.scale import check_depth_unit
        from egosim_jax.state.depth import state_from_depth
        from egosim_jax.types import Cameras

        cameras = actions[0].cameras
        depth_m = read_arrays(depth, {}, others=("depth_m",), packed=True)["depth_m"]
        if depth_m.shape != image.shape[:2]:
            raise InputError(
                f"{depth} has shape {depth_m.shape} and {self.image} {image.shape[:2]}: depth "
                "must have one value per pixel of the image as it is shown (turned as EXIF says). "
                "Compute it from that image, or resize it to that. (--depth)"
            )
        joints = np.concatenate([action.joints_m.reshape(-1, 3) for action in actions])
        taken = Cameras(
            world_from_camera=cameras.world_from_camera[:1],
            intrinsics_px=intrinsics,
            height=image.shape[0],
            width=image.shape[1],
        )
        local = transform(invert(taken.world_from_camera[0]), joints)
        try:
            check_depth_unit(taken, depth_m[None].astype(float), local[None, None])
        except InputError as error:
            raise InputError(f"{depth}: {error} (--depth)") from error
        ids, names = objects_of(
            self.objects or "auto",
            image,
            depth_m,
            intrinsics,
            detector=self.detector,
            phrases=self.phrases,
        )
        return state_from_depth(
            image,
            depth_m,
            intrinsics,
            cameras.world_from_camera[0],
            object_ids=ids,
            names=names_of(ids, names, self.names),
        )


@dataclass(frozen=True, kw_only=True)
class FromAnnotation:
    """Make an episode of a recorded video, from a clip that `egosim data annotate` accepted.

    The scene is the clip's first frame, and the actions are its cameras and hands. The ground truth
    is the video, cut into clips of the model's length, size and frame rate. To begin later, cut the
    video before annotation.
    """

    writes: ClassVar[Writes] = "folder or .zip file"
    clip: Annotated[Path, tyro.conf.Positional]
    """Folder of the annotated clip."""
    out: Path
    """Folder to write, or a file whose name ends in .zip."""
    config: str = "tabletop"
    """Model whose length, size and frame rate the clips have."""
    clips: int | None = None
    """Number of clips; by default as many as fit into the video."""

    def run(self) -> int:
        """Read the clip, make, check and write the episode."""
        from egosim_jax import configs
        from egosim_jax.annotate.to_episode import episode_from

        check_counts({"--clips": self.clips})
        episode = episode_from(self.clip, configs.get(self.config).video, clips=self.clips)
        return save_episode(episode, self.out, describe=True)


@dataclass(frozen=True, kw_only=True)
class FromLeRobot:
    """Make an episode from a LeRobot dataset (version 3.0) that has hands and cameras.

    `egosim data export --to lerobot` writes such datasets, including the scene of each episode.
    Other datasets need the features listed in docs/serving.md, and a --state. If a dataset has only
    videos, import and annotate a video instead (docs/video.md).
    """

    writes: ClassVar[Writes] = "folder or .zip file"
    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, with meta/info.json."""
    out: Path
    """Folder to write, or a file whose name ends in .zip."""
    episode: int = 0
    """Number of the episode in the dataset."""
    config: str = "tabletop"
    """Model whose length, size and frame rate the clips have."""
    state: Path | None = None
    """Folder of a state, or a .ply of colored points, instead of the dataset's own scene."""
    clips: int | None = None
    """Number of clips; by default as many as fit into the episode."""

    def run(self) -> int:
        """Read the dataset, make, check and write the episode."""
        from egosim_jax import configs
        from egosim_jax.annotate.lerobot_episode import episode_from_lerobot

        check_counts({"--clips": self.clips})
        state = None if self.state is None else read_state(self.state)
        video = configs.get(self.config).video
        episode = episode_from_lerobot(
            self.dataset, self.episode, video, state=state, clips=self.clips
        )
        return save_episode(episode, self.out, describe=True)


@dataclass(frozen=True, kw_only=True)
class CheckEpisode:
    """Validate an episode: files, joints, units, cameras, frame of reference.

    Prints a summary, or the first problem and its fix. Warns of a scene without objects.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """Folder or .zip of the episode."""
    config: str | None = None
    """Model that the clips must fit in length, size and frame rate."""

    def run(self) -> int:
        """Load the episode, which checks every file."""
        from egosim_jax import configs
        from egosim_jax.cli.objects import NO_OBJECTS
        from egosim_jax.cli.simulate import check_fits
        from egosim_jax.runtime.terminal import printable
        from egosim_jax.simulation.episode import Episode

        episode = Episode.load(self.path)
        if self.config is not None:
            check_fits(episode, configs.get(self.config).video, self.config)
        print_line(f"{self.path}: {summary(episode)}")
        if not (episode.state.object_ids > 0).any():
            print(printable(f"warning: {self.path}: {NO_OBJECTS}"), file=sys.stderr)
        return ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class ShowEpisode:
    """Draw an episode's inputs: the rendered initial state with the hands of each clip.

    Writes one contact sheet. The first row has the objects in their own colors, with their names.
    Each clip has a row with the initial state and the hands, seen from the clip's cameras, and a
    row of the ground truth if there is one.
    """

    writes: ClassVar[Writes] = "file"
    path: Annotated[Path, tyro.conf.Positional]
    """Folder or .zip of the episode."""
    out: Path | None = None
    """Image to write; by default NAME.png in the current folder."""
    renderer: RendererName = "jax"
    """Renderer of the view and the hands."""

    def run(self) -> int:
        """Render and write the contact sheet."""
        from egosim_jax.cli.simulate import sheet_moments
        from egosim_jax.data.sheet import SheetClip, draw_sheet
        from egosim_jax.simulation.episode import Episode

        episode = Episode.load(self.path)
        truths = episode.ground_truth or (None,) * len(episode.actions)
        sheet = [self._objects(episode)]
        for number, (action, truth) in enumerate(
            zip(episode.actions, truths, strict=True), start=1
        ):
            videos = {"view with hands": self._overlay(episode.state, action)}
            if truth is not None:
                videos["ground truth"] = truth.frames
            title = f"{number}: {action.prompt}   ({', '.join(videos)})"
            sheet.append(SheetClip(title, list(videos.values())))
        out = self.out or Path(f"{self.path.stem}.png")
        draw_sheet(sheet, out, moments=sheet_moments(episode.shape[0]))
        print_line(out)
        return ExitCode.DONE

    def _objects(self, episode: episodes.Episode) -> SheetClip:
        """Return the view of the first clip with colored objects and their names."""
        from egosim_jax import rendering
        from egosim_jax.data.sheet import SheetClip
        from egosim_jax.rendering.objects import draw_objects

        state, cameras = episode.state, episode.actions[0].cameras
        view = rendering.get(self.renderer).render(state, cameras, point_px=rendering.POINT_PX)
        numbers = sorted(set(state.object_ids[state.object_ids > 0].tolist()))
        listed = ", ".join(object_name(n, state.names) for n in numbers)
        title = f"objects: {listed or 'none'}"
        return SheetClip(title, [draw_objects(view, state.names)])

    def _overlay(self, state: SceneState, action: Action) -> np.ndarray:
        import numpy as np

        from egosim_jax import rendering

        renderer = rendering.get(self.renderer)
        view = renderer.render(state, action.cameras, point_px=rendering.POINT_PX)
        hands, depth_m = renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)
        return np.where((depth_m < view.depth_m)[..., None], hands, view.frames)


def read_state(path: Path) -> SceneState:
    """Read the folder of a state, or a .ply of colored points."""
    from egosim_jax.state.snapshot import load, read_ply

    return (read_ply if path.suffix == ".ply" else load)(path)


def save_episode(episode: episodes.Episode, out: Path, *, describe: bool = False) -> int:
    """Check and write the episode; print its summary and, with `describe`, its objects.

    Raises `InputError` if there is another episode: it may have been edited.
    """
    _keep_others(episode, out)
    episode.save(out)
    print_line(f"{out}: {summary(episode)}")
    if describe:
        from egosim_jax.cli.objects import describe_objects

        print_line(describe_objects(episode.state))
    return ExitCode.DONE


def _keep_others(episode: episodes.Episode, out: Path) -> None:
    """Raise `InputError` if there is an episode that is not equal to this one."""
    from egosim_jax.io.digest import fingerprint

    if not out.exists():
        return
    try:
        there = type(episode).load(out)
    except InputError:
        return  # damaged, or no episode: `save` decides
    if fingerprint(there) != fingerprint(episode):
        before, now = (counted(len(one.actions), "clip") for one in (there, episode))
        clips = f" of {before}, not {now}" if before != now else ", maybe an edited one"
        raise InputError(
            f"{out} has another episode{clips}. It is not replaced: choose another path, or remove "
            "it. (--out)"
        )


def summary(episode: episodes.Episode) -> str:
    """Return a one-line description of an episode."""
    import numpy as np

    frames, height, width = episode.shape
    with_truth = "with" if episode.ground_truth else "without"
    handless = [
        f"clip {number}"
        for number, action in enumerate(episode.actions, start=1)
        if not np.isfinite(action.joints_m).any()
    ]
    where = f" (none in {', '.join(handless)})" if handless else ""
    return (
        f"{counted(len(episode.actions), 'clip')} of {frames} frames of {width}x{height} at "
        f"{episode.fps} fps, {episode.actions[0].kind} hands{where}, "
        f"{len(episode.state.points_m)} points, {with_truth} ground truth"
    )


Episode = group(
    "Episode",
    "Make, check and show episodes: a scene, cameras, hands and prompts to simulate.",
    {
        "make": MakeEpisode,
        "from-annotation": FromAnnotation,
        "from-lerobot": FromLeRobot,
        "check": CheckEpisode,
        "show": ShowEpisode,
    },
)
