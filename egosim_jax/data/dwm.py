"""DWM's folders of triplets, and lists of their clips.

    DATASET/SCENE/ACTION/videos/NAME.mp4            recorded video (ground truth)
                         videos_static/NAME.mp4     static scene along the same cameras
                         videos_hands/NAME.mp4      hand meshes on black
                         prompts_rewrite/NAME.txt   rewritten caption, of the released models
                         prompts/NAME.txt           original caption, of the paper's evaluation

A list is a text file. Each line is the path of a recorded video, relative to a root folder: the
folder of the list or the one above it, whichever has the first video. DWM's lists are in
`dataset_files` of the root. Any number of folders may be above `videos`.

A static video has no mask, because it shows the scene everywhere. Its first frame is the image for
CLIP. The caption is the complete text of the file: DWM generates from it, but trained on its first
line. A clip without a rewritten caption gets the original one. If original captions are chosen,
each clip must have one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

from egosim_jax.data.clip_files import MAX_CLIPS, SAFE_IDS, ClipFiles, Problems, Prompts, is_safe_id
from egosim_jax.data.readers import inside, make_id
from egosim_jax.data.static import check_observed
from egosim_jax.io.bounded import quote, quote_path, quote_text, read_bytes
from egosim_jax.io.run import write_text
from egosim_jax.io.writing import write_video
from egosim_jax.types import InputError, Triplet

VIDEOS, STATIC, HANDS = "videos", "videos_static", "videos_hands"
"""Folders of recorded videos, static scenes and hand meshes."""
PROMPTS: dict[Prompts, tuple[Prompts, ...]] = {
    "prompts_rewrite": ("prompts_rewrite", "prompts"),
    "prompts": ("prompts",),
}
"""Caption folders to search, the preferred one first, for each choice of captions."""
LISTS = "dataset_files"
"""Folder of lists, in the root."""
MAX_LIST_BYTES, MAX_PROMPT_BYTES = 1 << 26, 1 << 16
"""Maximum size of a list and of a caption, in bytes."""


def read_list(path: Path, *, prompts: Prompts = "prompts_rewrite") -> list[ClipFiles]:
    """Return the clips of a list; their ids are their paths with underscores.

    `prompts` chooses the captions. Raises one `InputError` that lists the problems: no root, paths
    outside of it or not in a folder `videos`, missing and empty captions, duplicates.
    """
    entries = list(_entries(path))
    name = quote_path(path)
    if not entries or len(entries) > MAX_CLIPS:
        raise InputError(f"{name} lists {len(entries):,} clips: it must be 1 to {MAX_CLIPS:,}.")
    root = _root_of(path, entries[0][1])
    clips: dict[str, ClipFiles] = {}
    problems = Problems()
    for line, entry in entries:
        try:
            row = f"{path.name} line {line}"
            files = _files(root, entry, row, prompts)
            if files.video_id in clips:
                raise InputError(f"another line has the same id {files.video_id}")
            clips[files.video_id] = files
        except InputError as error:
            problems.add([f"line {line}: {error}".removesuffix(".")])
    problems.refuse(f"{name} cannot be used")
    return list(clips.values())


def _entries(path: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of the lines that are not empty."""
    text = _text(path, MAX_LIST_BYTES)
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            yield number, line.strip()


def _text(path: Path, limit: int) -> str:
    try:
        return read_bytes(path, limit=limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{quote_path(path)} is not text in UTF-8: {quote_text(str(error))}."
        ) from error


def _root_of(path: Path, entry: str) -> Path:
    """Return the root of the paths in a list."""
    roots = path.parent, path.parent / ".."
    for root in roots:
        if inside(root, entry, what=f"the first clip of {quote_path(path)}").is_file():
            return root
    raise InputError(
        f"{quote_path(path)}: its first clip {quote(entry)} must be a file below the folder of the "
        "list or the one above, and is in neither. Put the list into the root of the data, or into "
        f"{LISTS} there."
    )


def _files(root: Path, entry: str, row: str, prompts: Prompts) -> ClipFiles:
    video = inside(root, entry, what="the path")
    if video.parent.name != VIDEOS or video.suffix != ".mp4":
        raise InputError(
            f"the path {quote(entry)} must name an .mp4 in a folder {VIDEOS}: its static scene is "
            f"searched in {STATIC} next to that"
        )
    folder = video.parent.parent
    texts = [folder / name / f"{video.stem}.txt" for name in PROMPTS[prompts]]
    caption = next((text for text in texts if text.is_file()), texts[0])
    text = _text(caption, MAX_PROMPT_BYTES)
    prompt = " ".join(text.split())
    if not prompt:
        raise InputError(f"the caption {quote_path(caption)} is empty")
    static = folder / STATIC / video.name
    parts = Path(entry).with_suffix("").parts
    return ClipFiles(
        video_id=make_id(parts),
        prompt=prompt,
        prior=static,
        mask=None,
        hands=folder / HANDS / video.name,
        first_frame=static,
        target=video,
        extra={"dataset": parts[0]} if len(parts) > 2 else {},
        row=row,
    )


def write_folders(
    root: Path, triplets: Iterable[Triplet], *, name: str, fps: int | float | Fraction
) -> Path:
    """Write triplets in DWM's folders below a root, and their list; return the list's path.

    The id A/B/CLIP gives NAME/A/B/videos/CLIP.mp4, and the list is NAME.txt. Raises `InputError`
    for a name or id that is not a valid file name, for a triplet without a target video, and for a
    mask with holes, because the folders have no masks.
    """
    if "/" in name or not is_safe_id(f"{name}/0"):
        raise InputError(
            f"The name {quote(name)} of a dataset must be a valid folder name: use letters, "
            "digits, '_' and '-'. (--name)"
        )
    lines = []
    for triplet in triplets:
        if not is_safe_id(triplet.video_id):
            raise InputError(
                f"video_id {quote(triplet.video_id)} is not a valid file name; use {SAFE_IDS}."
            )
        if triplet.target is None:
            raise InputError(
                f"{triplet.video_id} has no recorded video: it must have a target, because DWM's "
                "lists name recorded videos."
            )
        try:
            check_observed(triplet.mask)
        except InputError as error:
            raise InputError(f"{triplet.video_id}: {error}") from error
        place = Path(name) / triplet.video_id
        videos = {VIDEOS: triplet.target, STATIC: triplet.prior, HANDS: triplet.hands}
        for kind, frames in videos.items():
            write_video(root / place.parent / kind / f"{place.name}.mp4", frames, fps)
        for kind in PROMPTS:
            write_text(root / place.parent / kind / f"{place.name}.txt", f"{triplet.prompt}\n")
        lines.append(f"{(place.parent / VIDEOS / place.name).as_posix()}.mp4\n")
    if not lines:
        raise InputError(f"No triplet was given for {quote_path(root)}: there must be at least 1.")
    path = root / LISTS / f"{name}.txt"
    write_text(path, "".join(lines))
    return path
