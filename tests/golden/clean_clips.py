"""Clean clips, videos and images: tables, lists, packing, annotation and comparison."""

import csv
from fractions import Fraction
from functools import partial

import av
import numpy as np
from PIL import Image

from egosim_jax.annotate.frames import Sampling, plan, read_frames
from egosim_jax.annotate.sources import find_sources, open_source
from egosim_jax.cli.data import Pack
from egosim_jax.data.clips import load_triplet
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.pack import frame_rates, read_triplets
from egosim_jax.data.shards import ShardReader
from egosim_jax.evaluation.measures import Pixels
from egosim_jax.evaluation.methods import Folder, Prior
from egosim_jax.evaluation.scoring import Protocol, ScoreCache, Scoring
from egosim_jax.io.images import read_depth_image, read_image
from egosim_jax.io.segments import probe_long_video, read_segment
from egosim_jax.io.video import probe_video, read_video, write_video
from egosim_jax.types import VideoSpec
from tests.golden import fingerprints as fp
from tests.golden.fingerprints import clean


def write_videos(folder, frames=25, fps=24, *, mask=True):
    """Write the videos of a clip: the left half is the frame's number, the right the video's."""
    names = ["videos/0.mp4", "videos_static/0.mp4", "videos_hands/0.mp4"]
    for number, name in enumerate(names):
        video = fp.coded(frames, 32, 48)
        video[:, :, 24:] = 60 + 60 * number
        write_video(folder / name, video, fps)
    if mask:
        odd = np.broadcast_to(255 * (np.arange(frames) // 2 % 2)[:, None, None, None], video.shape)
        write_video(folder / "videos_static/pc_mask_video.mp4", odd.astype(np.uint8), fps)
    return names


def triplet(found, count=25) -> fp.Fields:
    """Yield which frames a triplet has, and which video's they are."""
    yield "about", [found.video_id, found.prompt, dict(found.extra)]
    for name in ("target", "prior", "hands"):
        frames = getattr(found, name)
        yield f"{name}, shown", fp.shown(frames, count)
        yield f"{name}, right half, levels", fp.means(frames[0, :, -4:])
        yield f"{name}, size", list(frames.shape[:3])
    yield "mask", (found.mask.mean(axis=(1, 2)) > 127).astype(int).tolist()
    yield "first frame, levels", fp.means(found.first_frame[:6, :6])


def write_table(folder):
    """Write a table of two clips in EgoSim's columns."""
    columns = ("video", "ego_prior_video", "hand_keypoint_video")
    rows = []
    for name in "ab":
        paths = write_videos(folder / name)
        Image.fromarray(fp.coded(25, 32, 48)[3]).save(folder / name / "image.png")
        row = dict(zip(columns, (f"{name}/{path}" for path in paths), strict=True))
        text = f"Hände, {name}"
        row |= {"first_frame": f"{name}/image.png", "prompt": text, "video_id": name, "split": "s"}
        rows.append(row)
    with (folder / "metadata.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder / "metadata.csv"


def write_list(folder, fps=24):
    """Write a DWM list of one clip."""
    write_videos(folder / "taste/open", fps=fps, mask=False)
    for name, text in {"prompts_rewrite": "I open it.\nSlowly. \n", "prompts": "open"}.items():
        (folder / "taste/open" / name).mkdir()
        (folder / "taste/open" / name / "0.txt").write_text(text)
    (folder / "dataset_files").mkdir()
    (folder / "dataset_files/test.txt").write_text("taste/open/videos/0.mp4\n")
    return folder / "dataset_files/test.txt"


@clean("table of clips")
def table_of_clips(folder):
    for files in read_metadata(write_table(folder)):
        taken = load_triplet(files, VideoSpec(frames=9, height=64, width=96), start=8)
        yield from fp.under(files.video_id, triplet(taken))


@clean("DWM list")
def dwm_list(folder):
    for prompts in ("prompts_rewrite", "prompts"):
        (files,) = read_metadata(write_list(folder / prompts), prompts=prompts)
        taken = load_triplet(files, VideoSpec(frames=9, height=32, width=48, fps=8))
        yield from fp.under(prompts, triplet(taken))


@clean("pack, files", write_table, None, "first")
@clean("pack, first", write_table, (32, 48), "first")
@clean("pack, stride", write_list, (32, 48), "stride")
@clean("pack, linspace", write_list, (64, 96), "linspace")
@clean("pack, rate", write_list, (32, 48), "rate")
@clean("pack, rate of 30 fps", partial(write_list, fps=30), (32, 48), "rate")
def packed(folder, write, size, rule):
    settings = {} if size is None else {"size": size, "num_frames": 9, "resampling": rule}
    assert Pack(metadata=write(folder), out=folder / "shards", **settings).run() == 0
    reader = ShardReader(folder / "shards")
    yield "kind", [reader.manifest.kind, sorted(reader.manifest.arrays), len(reader)]
    yield "rates", sorted(map(str, frame_rates(reader, len(reader))))
    for found in read_triplets(reader):
        yield from fp.under(found.video_id, triplet(found))


@clean("annotate, 30 fps", 40, 30, None)
@clean("annotate, 60 to 16 fps", 40, 60, 16.0)
@clean("annotate, 120 fps", 41, 120, None)
@clean("annotate, 29.97 to 10 fps", 40, Fraction(30000, 1001), 10.0)
def annotated(folder, count, fps, to):
    write_video(folder / "kitchen/take 1.mp4", fp.coded(count, 48, 80), fps)
    (source,) = find_sources([folder / "kitchen"])
    found = open_source(source)
    fitted = plan(found, Sampling(fps=to), cut=True)
    yield "source", [source.name, found.frames, str(found.fps), found.width, found.height]
    yield "plan", [str(fitted.fps), fitted.count, fitted.width, fitted.height]
    yield "indices", fitted.indices(0, fitted.count).tolist()
    yield "shown", fp.shown(read_frames(found, fitted, 0, fitted.count), count)


@clean("annotate, size and lens", (64, 96))
def annotated_at_a_size(folder, size):
    write_video(folder / "take.mp4", fp.coded(24, 108, 192), 30)
    found = open_source(find_sources([folder / "take.mp4"])[0])
    for name, wanted in {"own": None, "given": size}.items():
        fitted = plan(found, Sampling(size=wanted), cut=False)
        frames = read_frames(found, fitted, 3, 12)
        yield f"{name}, size", [fitted.width, fitted.height, list(frames.shape[:3])]
        yield f"{name}, scale", fp.numbers([fitted.scale, *fitted.offset_px])
        lens = np.array([[140.0, 0, 95.5], [0, 140, 53.5], [0, 0, 1]])
        yield f"{name}, intrinsics", fp.numbers(fitted.intrinsics(lens))
        yield f"{name}, shown", fp.shown(frames, 24)


@clean("video H.264", "mp4", "libx264", Fraction(24000, 1001))
@clean("video H.264 in mkv", "mkv", "libx264", Fraction(30))
@clean("video AV1", "mp4", "libsvtav1", Fraction(25))
def video(folder, suffix, codec, fps):
    path = folder / f"video.{suffix}"
    options = {"libx264": {"g": "12", "bf": "3"}, "libsvtav1": {"preset": "12", "g": "8"}}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps, options=options[codec])
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for frame in fp.coded(30, 64, 96):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    for probe in (probe_video, probe_long_video):
        info = probe(path)
        facts = [info.frames, info.width, info.height, str(info.fps)]
        yield probe.__name__, facts
    times_s = probe_long_video(path).timeline.times_s
    yield "even", bool(np.abs(times_s - np.arange(30) / float(fps)).max() < 2e-3)
    readings = {
        "all": partial(read_video),
        "middle": partial(read_video, start=11, stop=17),
        "official": partial(read_video, stop=9, decoding="official"),
        "segment": partial(read_segment, start=13, count=9),
        "last": partial(read_segment, start=29, count=1),
    }
    for name, read in readings.items():
        taken = read(path)
        yield name, [str(taken.fps), fp.shown(taken.frames, 30)]


@clean("video colors")
def video_colors(folder):
    colors = np.array([[[200, 30, 40], [30, 180, 60]], [[40, 60, 210], [120, 120, 120]]], np.uint8)
    frames = np.broadcast_to(colors.repeat(32, 0).repeat(48, 1), (3, 64, 96, 3))
    write_video(folder / "video.mp4", frames, 16)
    for decoding in ("accurate", "official"):
        found = read_video(folder / "video.mp4", decoding=decoding).frames[1]
        yield f"{decoding}, levels", found[[16, 16, 48, 48], [24, 72, 24, 72]].tolist()


@clean("images")
def images(folder):
    color = np.zeros((6, 8, 3), np.uint8)
    color[:3], color[3:] = [200, 40, 90], [20, 160, 60]
    gray = np.repeat(np.arange(10, 250, 30, dtype=np.uint8)[None], 6, axis=0)
    written = {
        "rgb.png": Image.fromarray(color),
        "rgb.bmp": Image.fromarray(color),
        "gray.png": Image.fromarray(gray),
        "gray 16.png": Image.fromarray(gray.astype(np.uint16) * 257),
        "alpha.png": Image.fromarray(np.dstack([color, gray])),
        "palette.png": Image.fromarray(color).quantize(2),
    }
    for name, image in written.items():
        image.save(folder / name)
        found = read_image(folder / name)
        yield name, [list(found.shape), found[0].tolist(), found[-1].tolist()]
    for name, options in {"color.jpg": {"subsampling": 0}, "gray.jpg": {}}.items():
        large = np.kron(color if options else gray[..., None], np.ones((8, 8, 1), np.uint8))
        Image.fromarray(large.squeeze()).save(folder / name, quality=95, **options)
        found = read_image(folder / name)
        yield f"{name}, size", list(found.shape)
        yield f"{name}, levels", found[[4, -5]][:, 4::8].tolist()


@clean("depth maps")
def depth_maps(folder):
    depth = np.arange(500, 548, dtype=np.uint16).reshape(6, 8)
    Image.fromarray(depth).save(folder / "depth.png")
    np.save(folder / "depth.npy", depth.astype(np.float32) / 1000)
    for name in ("depth.png", "depth.npy"):
        found = read_depth_image(folder / name)
        yield name, [str(found.dtype), fp.numbers(found)]


@clean("clips to compare")
def compared(folder):
    clips = read_metadata(write_table(folder))
    (folder / "made").mkdir()
    for files in clips:
        brighter = read_video(files.target).frames[:17] + np.uint8(8)  # 30.07 dB of the same frame
        write_video(folder / f"made/{files.video_id}.mp4", brighter, 24)
    made = Folder(path=folder / "made", name="made", title="made")
    scoring = Scoring(
        methods=[made, Prior()],
        measures=[Pixels()],
        protocol=Protocol(),
        cache=ScoreCache(folder / "cache.jsonl"),
    )
    for row in scoring.run(clips):
        name = f"{row.window.output_id}, {row.method}"
        yield name, [*map(int, row.shape[:3]), row.window.start]
        yield f"{name}, psnr_db", round(float(row.scores["psnr"]), 2)
