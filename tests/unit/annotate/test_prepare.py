"""Shots, windows and quality of videos."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.annotate.frames import Sampling, plan
from egosim_jax.annotate.prepare import Cutting, Quality, differs, scan, windows
from egosim_jax.annotate.sources import find_sources, open_source
from egosim_jax.types import InputError
from tests.unit.annotate.stubs import textured_video, write


def choose(tmp_path, frames, *, length=None, **rules):
    path = write(tmp_path / "a.mp4", frames)
    recording = open_source(find_sources([path])[0])
    fitted = plan(recording, Sampling(num_frames=length), cut="clips" in rules)
    return windows(recording, scan(recording, fitted), length, Cutting(**rules))


def test_a_video_is_one_clip_of_4k_plus_1_frames(tmp_path):
    (window,) = choose(tmp_path, textured_video(20))
    assert (window.video_id, window.start, window.stop, window.refused) == ("a", 0, 17, None)


def test_a_cut_ends_a_shot(tmp_path):
    shots = [textured_video(20, shift=0.2), textured_video(19, seed=1, shift=0.2)]
    frames = np.concatenate(shots)
    (window,) = choose(tmp_path, frames)
    assert window.refused == ("cut", "the shot changes at frame 20: a clip is one shot. (--clips)")
    cut = choose(tmp_path, frames, length=9, clips=True)
    assert [(w.video_id, w.start, w.stop) for w in cut] == [
        ("a_0_8", 0, 9), ("a_9_17", 9, 18), ("a_20_28", 20, 29), ("a_29_37", 29, 38),
    ]  # fmt: skip


def test_a_fast_turn_is_not_a_cut(tmp_path):
    (window,) = choose(tmp_path, textured_video(17, shift=12.0), quality=Quality(max_motion=99.0))
    assert window.refused is None


def test_black_frames_belong_to_no_clip(tmp_path):
    frames = textured_video(40)
    frames[12:25] = 3
    (window,) = choose(tmp_path, frames)
    assert window.refused is not None
    cut = choose(tmp_path, frames, length=9, clips=True)
    assert [(w.start, w.refused) for w in cut] == [(0, None), (25, None)]


def noisy(image):
    noise = np.random.default_rng(0).normal(0, 8, (17, *image.shape))
    return np.clip(image + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("frames", "rule"),
    [
        (np.full((17, 48, 80, 3), 2, np.uint8), "black"),
        (np.full((17, 48, 80, 3), 120, np.uint8), "blur"),
        (np.repeat(textured_video(1), 17, axis=0), "still"),
        (noisy(textured_video(1)[0]), "still"),
    ],
)
def test_bad_clips_are_refused_with_rule_and_figure(tmp_path, frames, rule):
    (window,) = choose(tmp_path, frames)
    assert window.refused is not None
    assert window.refused[0] == rule
    assert "(--m" in window.refused[1]


@pytest.mark.parametrize("fps", [8, 30])
def test_noise_is_no_motion(fps):
    rng = np.random.default_rng(0)
    image, lag = rng.uniform(40, 210, (18, 32)), fps // 2
    for noise in (0.3, 0.8, 2.0):
        a, b, c = image + rng.normal(0, noise, (3, 18, 32))
        assert not differs(a, b, c)
    shifted = [np.roll(image, 1, axis=1) * k / lag + image * (1 - k / lag) for k in range(lag + 1)]
    noisy = [frame + rng.normal(0, 0.3, image.shape) for frame in shifted]
    assert differs(noisy[0], noisy[-2], noisy[-1])


def test_thresholds_can_be_switched_off(tmp_path):
    free = Quality(min_sharpness=0.0, max_black=1.0, min_motion=0.0)
    frames = np.full((17, 48, 80, 3), 2, np.uint8)
    (window,) = choose(tmp_path, frames, quality=free)
    assert window.refused is None


def test_shaking_is_refused(tmp_path):
    frames = textured_video(17, shift=3.0)
    (window,) = choose(tmp_path, frames, quality=Quality(max_motion=0.2))
    assert window.refused is not None
    assert window.refused[0] == "shaken"
    assert window.figures["camera_motion"] == pytest.approx(3 * 16 / 80, rel=0.2)


def test_ids_are_unique_names(tmp_path):
    frames = textured_video(9)
    for name in ("x/video.mp4", "y/video.mp4", "z 1/take: two.mp4"):
        write(tmp_path / name, frames)
    (tmp_path / "notes.txt").touch()
    assert [s.name for s in find_sources([tmp_path])] == ["x", "y", "take_two"]
    with pytest.raises(InputError, match="does not exist"):
        find_sources([tmp_path / "none.mp4"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no video"):
        find_sources([tmp_path / "empty"])


def test_no_video_in_a_folder_is_passed_over_whatever_its_suffix(tmp_path):
    video = write(tmp_path / "made.mkv", textured_video(9)).read_bytes()
    suffixes = [".ts", ".m4v", ".MTS", ".m2ts", ".MOV", ".3gp", ".WebM", ".avi", ".wmv", ".MPG"]
    for number, suffix in enumerate(suffixes):
        (tmp_path / "set").mkdir(exist_ok=True)
        (tmp_path / "set" / f"take_{number}{suffix}").write_bytes(video)
    (tmp_path / "set/notes.txt").touch()
    assert [s.path.suffix for s in find_sources([tmp_path / "set"])] == suffixes


def test_videos_of_one_name_take_their_folders(tmp_path):
    frames = textured_video(9)
    for name in ("x/take.mp4", "y/take.mp4"):
        write(tmp_path / name, frames)
    found = find_sources([tmp_path])
    assert [s.name for s in found] == ["x_take", "y_take"]
    write(tmp_path / "x_take.mp4", frames)
    write(tmp_path / "deeper/x/take.mp4", frames)
    with pytest.raises(InputError, match="with the same id"):
        find_sources([tmp_path])


def test_depth_of_others_is_found_by_frame(tmp_path):
    path = write(tmp_path / "a.mp4", textured_video(9))
    folder = tmp_path / "depth" / "a"
    folder.mkdir(parents=True)
    np.save(folder / "000003.npy", np.full((48, 80), 1.5, np.float32))
    recording = open_source(find_sources([path])[0], tmp_path / "depth")
    assert recording.read_depth(2) is None
    depth = recording.read_depth(3)
    assert depth is not None
    assert depth[0, 0] == 1.5
    (source,) = find_sources([path])
    with pytest.raises(InputError, match="no depth maps"):
        open_source(replace(source, name="b"), tmp_path / "depth")


def test_hdr_is_refused_before_it_is_decoded(tmp_path):
    import av

    with av.open(tmp_path / "hdr.mp4", "w") as container:
        stream = container.add_stream("libx264", rate=16)
        stream.width, stream.height, stream.pix_fmt = 80, 48, "yuv420p"
        stream.codec_context.color_trc = 16
        for frame in textured_video(9):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    (source,) = find_sources([tmp_path / "hdr.mp4"])
    with pytest.raises(InputError, match=r"is HDR .*FFmpeg"):
        open_source(source)
