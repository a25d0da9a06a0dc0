"""DWM's folders and lists: written clips are read back, and every mistake is named."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from egosim_jax.cli.data import Pack
from egosim_jax.cli.generate import Generate
from egosim_jax.data.clips import check_clip, load_triplet
from egosim_jax.data.dwm import write_folders
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.pack import pack, read_triplets
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.transforms import decode_record, resample
from egosim_jax.io.writing import write_video
from egosim_jax.types import InputError, Triplet, VideoSpec

SPEC = VideoSpec(frames=5, height=32, width=48, fps=8)


def make_triplet(name, seed=0):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:32, :48]
    prior, hands, target = (
        np.stack([(3 * x + 2 * y + shift + 4 * f)[..., None] % 200 + [0, 20, 40] for f in range(5)])
        for shift in rng.integers(0, 60, 3)
    )
    return Triplet(
        video_id=name,
        prompt="The hand opens the drawer.",
        prior=prior.astype(np.uint8),
        mask=np.zeros((5, 32, 48), np.uint8),
        hands=hands.astype(np.uint8),
        first_frame=prior[0].astype(np.uint8),
        target=target.astype(np.uint8),
    )


@pytest.fixture
def root(tmp_path):
    triplets = [make_triplet("open/00000"), make_triplet("carry/00000", 1)]
    write_folders(tmp_path, triplets, name="train", fps=8)
    return tmp_path


def near(video, other, most=8):
    return np.abs(video.astype(int) - other).mean() < most


def test_a_written_list_is_read(root):
    path = root / "dataset_files" / "train.txt"
    assert path.read_text("utf-8").splitlines() == [
        "train/open/videos/00000.mp4",
        "train/carry/videos/00000.mp4",
    ]
    clips = read_metadata(path)
    assert [clip.video_id for clip in clips] == [
        "train_open_videos_00000",
        "train_carry_videos_00000",
    ]
    assert not check_clip(clips[1], SPEC)
    triplet, given = load_triplet(clips[1], SPEC), make_triplet("carry/00000", 1)
    assert triplet.prompt == given.prompt
    assert not triplet.mask.any()
    for name in ("prior", "hands", "target", "first_frame"):
        assert near(getattr(triplet, name), getattr(given, name))
    assert not near(triplet.prior, given.target)


def test_datasets_of_one_root_keep_their_clips_and_names(root):
    own = [make_triplet("open/00000", 2)]
    path = write_folders(root, own, name="own", fps=8)
    (clip,), others = read_metadata(path), read_metadata(root / "dataset_files" / "train.txt")
    assert clip.extra == {"dataset": "own"}
    assert others[0].extra == {"dataset": "train"}
    assert near(load_triplet(clip, SPEC).target, own[0].target)
    assert near(load_triplet(others[0], SPEC).target, make_triplet("open/00000").target)
    for name in ("a/b", "..", "a.b", ""):
        with pytest.raises(InputError, match="must be a valid folder name: use letters"):
            write_folders(root, own, name=name, fps=8)


def test_original_captions_serve_where_there_are_no_rewritten_ones(root):
    folder = root / "train" / "open"
    (folder / "prompts_rewrite" / "00000.txt").unlink()
    (folder / "prompts" / "00000.txt").write_text("I open\nthe drawer. \n", "utf-8")
    assert read_metadata(root / "dataset_files" / "train.txt")[0].prompt == "I open the drawer."


def original_captions(root):
    """Write original captions that differ from the rewritten ones; return a list in the root."""
    for number, folder in enumerate(("open", "carry")):
        path = root / "train" / folder / "prompts" / "00000.txt"
        path.write_text(f"original {number}", "utf-8")
    (root / "own.txt").write_text(f"\n{clips_list(root).read_text('utf-8')}\n", "utf-8")
    return root / "own.txt"


def test_original_captions_can_be_chosen_and_are_then_required(root):
    path = original_captions(root)
    assert [c.prompt for c in read_metadata(path)] == 2 * ["The hand opens the drawer."]
    chosen = read_metadata(path, prompts="prompts")
    assert [c.prompt for c in chosen] == ["original 0", "original 1"]
    (root / "train" / "open" / "prompts" / "00000.txt").unlink()
    with pytest.raises(InputError, match=r"open/prompts/00000\.txt"):
        read_metadata(path, prompts="prompts")


def test_commands_take_the_chosen_captions(root, tmp_path):
    path, shards = original_captions(root), tmp_path / "shards"
    Pack(metadata=path, out=shards, prompts="prompts").run()
    packed = [record.metadata["prompt"] for record in ShardReader(shards)]
    assert packed == ["original 0", "original 1"]
    windows = Generate(config="debug", prompts="prompts")._windows(path)
    assert [window.files.prompt for window in windows] == packed


def test_captions_of_a_column_cannot_be_chosen(clips, tmp_path):
    with pytest.raises(InputError, match="in the column prompt: prompts can be chosen only"):
        Pack(metadata=clips, out=tmp_path / "shards", prompts="prompts").run()
    with pytest.raises(InputError, match="scenes of the tabletop world have one caption"):
        Generate(config="debug", prompts="prompts").run()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("train/open/videos/00000.mp4\n../x/videos/1.mp4", "without '..'"),
        ("train/open/videos/00000.mp4\ntrain/open/videos/00000.mp4", "another line"),
        ("train/open/videos/00000.mp4\ntrain/open/00000.mp4", "in a folder videos"),
        ("train/open/videos/00000.mp4\ntrain/open/videos/7.mp4", "prompts_rewrite/7.txt"),
        ("train/else/videos/00000.mp4", "and is in neither"),
        ("\n\n", "lists 0 clips"),
    ],
)
def test_wrong_lists_are_refused(root, lines, message):
    path = root / "dataset_files" / "wrong.txt"
    path.write_text(lines, "utf-8")
    with pytest.raises(InputError, match=message):
        read_metadata(path)


def test_videos_are_packed_without_a_mask_and_written_again(root, tmp_path):
    clips = read_metadata(root / "dataset_files" / "train.txt")
    shards = tmp_path / "shards"
    assert list(pack(clips, out=shards, spec=None, provenance={})) == [None, None]
    reader = ShardReader(shards)
    assert "mask" not in reader.manifest.arrays
    decoded = decode_record(reader[0].arrays, SPEC)
    assert not decoded["mask"].any()
    assert (decoded["first_frame"] == decoded["prior"][0]).all()
    path = write_folders(tmp_path / "again", read_triplets(reader), name="again", fps=8)
    first, again = (load_triplet(read_metadata(p)[0], SPEC) for p in (clips_list(root), path))
    assert near(first.target, again.target)
    assert again.prompt == first.prompt


def clips_list(root):
    return root / "dataset_files" / "train.txt"


def test_rules_of_resampling_are_those_of_dwm():
    assert resample(100, 49, "first").tolist() == list(range(49))
    assert resample(190, 49, "stride").tolist() == list(range(0, 147, 3))
    assert resample(278, 49, "step", ratio=Fraction(30, 8)).tolist() == list(range(0, 147, 3))
    assert resample(60, 5, "step", ratio=Fraction(1, 2)).tolist() == [0, 1, 2, 3, 4]
    assert resample(9, 5, "linspace").tolist() == [0, 2, 4, 6, 8]
    assert resample(8, 5, "linspace").tolist() == [0, 2, 4, 5, 7]  # half to even, as torch.round
    assert resample(3, 5, "linspace").tolist() == [0, 0, 1, 2, 2]


def test_frames_by_rate_are_the_nearest_in_time():
    assert resample(9, 5, "rate", ratio=Fraction(30, 16)).tolist() == [0, 2, 4, 6, 8]
    assert resample(9, 5, "rate", ratio=Fraction(30, 8)).tolist() == [0, 4, 8]
    assert resample(9, 5, "rate", ratio=Fraction(12, 8)).tolist() == [0, 2, 3, 5, 6]


def test_frames_are_taken_at_intervals(root):
    clip = read_metadata(clips_list(root))[0]
    for path in (clip.prior, clip.hands, clip.target):
        write_video(path, make_triplet("a").target.repeat(3, axis=0)[:14], 8)
    taken = load_triplet(clip, SPEC, resampling="linspace")
    assert near(taken.target[2], make_triplet("a").target[2])
    assert near(taken.target[4], make_triplet("a").target[4])
    with pytest.raises(InputError, match="14 frames cannot be encoded"):
        load_triplet(clip, SPEC)
    with pytest.raises(InputError, match="fewer than the 17"):
        load_triplet(clip, VideoSpec(frames=17, height=32, width=48, fps=8), resampling="stride")
    with pytest.raises(InputError, match="need a size"):
        list(pack([clip], out=root / "x", spec=None, provenance={}, resampling="rate"))


def packed_by_rate(root, rates):
    """Return a clip of 14 frames, each three times, with videos of these frame rates."""
    clip = read_metadata(clips_list(root))[0]
    paths = {"target": clip.target, "prior": clip.prior, "hands": clip.hands}
    for name, path in paths.items():
        frames = getattr(make_triplet("a"), name).repeat(3, axis=0)[:14]
        write_video(path, frames, rates.get(name, 24))
    spec = VideoSpec(frames=5, height=32, width=48, fps=8)
    return load_triplet(clip, spec, resampling="rate")


def test_frames_taken_by_rate_are_the_same_in_every_video(root):
    taken, whole = packed_by_rate(root, {"prior": Fraction(24000, 1001)}), make_triplet("a")
    for name in ("prior", "hands", "target"):
        for frame in range(5):
            assert near(getattr(taken, name)[frame], getattr(whole, name)[frame], most=2)


def test_videos_of_other_rates_are_not_taken_by_rate(root):
    with pytest.raises(InputError, match=r"rates disagree: prior 24, hands 8, target 24\..*rule"):
        packed_by_rate(root, {"hands": 8})


def test_triplets_without_a_recorded_video_are_refused(tmp_path):
    with pytest.raises(InputError, match="must have a target"):
        write_folders(tmp_path, [replace(make_triplet("a"), target=None)], name="x", fps=8)
