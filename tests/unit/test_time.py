"""Video frames at given times: the same rule for every reader and command."""

import json
import shutil
from fractions import Fraction
from functools import cache, partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.data.importing import import_recordings
from egosim_jax.data.readers.agibot import AgiBot
from egosim_jax.data.readers.egodex import EgoDex
from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.egovid import EgoVid
from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.data.readers.lerobot import LeRobot
from egosim_jax.data.readers.taste_rob import TasteRob
from egosim_jax.data.recording import Recording
from egosim_jax.io.timing import Timeline, row_times
from egosim_jax.io.video import probe_video, read_moments, read_video
from egosim_jax.types import InputError
from tests.captures import World
from tests.films import EVEN, FILMS, FPS, FRAMES, HEIGHT, WIDTH, numbers, write_film, write_paused
from tests.unit.data.readers import (
    test_agibot,
    test_egodex,
    test_egosim,
    test_egovid,
    test_hot3d,
    test_lerobot,
)
from tests.unit.data.readers.test_lerobot import KEY

NTSC = Fraction(1, 30000)


class Filmed(World):
    """A scene whose video is a film."""

    def __init__(self, film, rows):
        super().__init__(frames=rows, height=HEIGHT, width=WIDTH)
        self.film = film

    def write_video(self, path, **_):
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(self.film, path)


def write_lerobot(root, film, rows, version, *, fps=FPS, starts=(0.0,), stamps=None):
    v3 = version == "v3.0"
    place = "file-{file_index}" if v3 else "episode_{episode_index}"
    for folder in ("meta/episodes/chunk-000", "videos", "data"):
        (root / folder).mkdir(parents=True)
    paths = {"video_path": f"videos/{place}.mp4", "data_path": f"data/{place}.parquet"}
    test_lerobot.write_info(root, version, fps=fps, **paths)
    count = len(starts)
    name = "file-0" if v3 else "episode_0"
    shutil.copy(film, root / f"videos/{name}.mp4")
    if stamps is not None:
        columns = {"episode_index": [0] * rows, "frame_index": [*range(rows)], "timestamp": stamps}
        pq.write_table(pa.table(columns), root / f"data/{name}.parquet")
    if not v3:
        line = {"episode_index": 0, "tasks": ["wave"], "length": rows}
        (root / "meta/episodes.jsonl").write_text(json.dumps(line))
        return LeRobot(source=root)
    episodes = {
        "episode_index": [*range(count)],
        "length": [rows] * count,
        "tasks": [["wave"]] * count,
        "data/chunk_index": [0] * count,
        "data/file_index": [0] * count,
        f"videos/{KEY}/chunk_index": [0] * count,
        f"videos/{KEY}/file_index": [0] * count,
        f"videos/{KEY}/from_timestamp": [*starts],
    }
    pq.write_table(pa.table(episodes), root / "meta/episodes/chunk-000/file-000.parquet")
    return LeRobot(source=root)


def write_egodex(root, film, rows):
    test_egodex.write_episode(Filmed(film, rows), root / "0.hdf5")
    return EgoDex(source=root)


def write_egovid(root, film, rows):
    root.mkdir()
    test_egovid.write_set(root, Filmed(film, rows), span=(0, rows))
    return EgoVid(source=root)


def write_agibot(root, film, rows):
    test_agibot.write_episode(root, Filmed(film, rows), parts=False)
    return AgiBot(source=root)


def write_egosim(root, film, rows):
    test_egosim.write_clip(root / "clip", Filmed(film, rows))
    return EgoSimClips(source=root)


def write_taste_rob(root, film, rows):
    Filmed(film, rows).write_video(root / "a.mp4")
    (root / "a.csv").write_text("video,caption\na.mp4,wave\n")
    return TasteRob(source=root)


READERS = {
    "lerobot v2.0": partial(write_lerobot, version="v2.0"),
    "lerobot v2.1": partial(write_lerobot, version="v2.1"),
    "lerobot v3.0": partial(write_lerobot, version="v3.0"),
    "egodex": write_egodex,
    "egovid": write_egovid,
    "agibot": write_agibot,
    "egosim": write_egosim,
    "taste_rob": write_taste_rob,
}


def imported(reader, out):
    outcomes = list(import_recordings(reader, out)[1])
    problems = [outcome.problem for outcome in outcomes if outcome.problem]
    return [Recording.load(out / o.recording_id) for o in outcomes if not o.problem], problems


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a function that writes a film once and gives its path."""
    folder = tmp_path_factory.mktemp("films")

    @cache
    def write(film):
        path = folder / f"{film}.mp4".replace(" ", "_")
        FILMS[film][0](path)
        return path

    return write


@pytest.mark.parametrize("film", FILMS)
def test_a_frame_is_the_one_of_its_time(film, written):
    path, (_, expected) = written(film), FILMS[film]
    assert probe_video(path).frames == len(expected)
    parts = [slice(None), slice(0, 5), slice(5, 11), slice(11, len(expected))]
    for part in parts:
        video = read_video(path, start=part.start or 0, stop=part.stop)
        assert numbers(video.frames) == expected[part]
    moments = read_moments(path, np.array([0.1, 0.1, 0.3, 11 / 30]))
    assert numbers(moments.frames) == [expected[k] for k in (3, 3, 9, 11)]


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_takes_frames_by_time(reader, written, tmp_path):
    _, expected = FILMS["missing frame"]
    dataset = READERS[reader](tmp_path / "set", written("missing frame"), len(expected))
    (recording,), problems = imported(dataset, tmp_path / "out")
    assert not problems
    assert recording.fps == FPS
    assert numbers(recording.read_frames().frames) == expected


@pytest.mark.parametrize("reader", ["lerobot v3.0", "egovid"])
def test_a_variable_rate_is_refused_by_readers(reader, tmp_path):
    film = write_paused(tmp_path / "film.mp4")
    _, problems = imported(READERS[reader](tmp_path / "set", film, FRAMES), tmp_path / "out")
    assert "variable frame rate" in problems[0]
    assert "0.23 and 0.60 s" in problems[0]
    assert "`ffmpeg -i IN -vf fps=30 OUT`" in problems[0]


@pytest.mark.parametrize(
    ("reader", "rows"),
    [
        *((name, FRAMES - 1) for name in ("lerobot v2.0", "lerobot v3.0", "egodex", "egovid")),
        *((name, FRAMES + 1) for name in ("lerobot v2.1", "lerobot v3.0", "egovid", "egosim")),
        ("agibot", FRAMES - 1),
    ],
)
def test_of_different_lengths_what_fits_is_used(reader, rows, tmp_path, caplog):
    film = write_film(tmp_path / "film.mp4")
    (recording,), problems = imported(READERS[reader](tmp_path / "set", film, rows), tmp_path / "o")
    assert not problems
    fits = min(rows, FRAMES)
    frames = recording.read_frames().frames
    if reader == "egovid" and rows < FRAMES:  # flat images do not decide its poses
        assert recording.world_from_camera is None
        frames = frames[:fits]
    assert numbers(frames) == [*range(FRAMES)][:fits]
    if recording.world_from_camera is not None:
        expected = World(frames=rows).poses[:fits]
        np.testing.assert_allclose(recording.world_from_camera, expected, atol=1e-5)
    if not (reader == "lerobot v3.0" and rows < FRAMES):
        assert str(rows) in caplog.text


@pytest.mark.parametrize(
    ("reader", "rows", "fps"),
    [
        ("lerobot v2.0", 22, "27.5"),
        ("lerobot v2.1", 28, "35"),
        ("egodex", 20, "25"),
        ("agibot", 16, "20"),
        ("egosim", 12, "15"),
    ],
)
def test_rows_of_another_rate_are_refused_at_any_ratio(reader, rows, fps, tmp_path):
    film = write_film(tmp_path / "film.mp4")
    found, problems = imported(READERS[reader](tmp_path / "set", film, rows), tmp_path / "o")
    assert not found
    assert f"24 frames and {rows} " in problems[0]
    assert f"`ffmpeg -i IN -vf fps={fps} OUT`" in problems[0]


def test_states_of_another_rate_than_poses_are_refused(tmp_path):
    dataset = write_agibot(tmp_path / "set", write_film(tmp_path / "film.mp4"), FRAMES)
    path = next(tmp_path.rglob("head_extrinsic_params_aligned.json"))
    path.write_text(json.dumps(json.loads(path.read_text())[:18]))
    assert "24 frames and 18 camera poses" in imported(dataset, tmp_path / "o")[1][0]


@pytest.mark.parametrize(
    ("version", "start_s", "unit", "message"),
    [
        ("v2.1", 0.0, 1e3, "seems to be in milliseconds"),
        ("v3.0", 1.7e9, 1e3, "seems to be in milliseconds"),
        ("v3.0", 0.0, 1e6, "seems to be in microseconds"),
        ("v2.1", 1.7e9, 1e9, "seems to be in nanoseconds"),
        ("v2.1", 0.3, 1, "Subtract its first value"),
        ("v3.0", 26.333, 1, "Subtract its first value"),
        ("v3.0", -0.2, 1, "Subtract its first value"),
        ("v2.1", 1.7e9, 1, "Subtract its first value"),
    ],
)
def test_time_stamps_in_another_unit_or_from_elsewhere_are_refused(
    version, start_s, unit, message, tmp_path
):
    film = write_film(tmp_path / "film.mp4")
    stamps = [(start_s + k / 30) * unit for k in range(24)]
    dataset = write_lerobot(tmp_path / "set", film, 24, version, stamps=stamps)
    assert message in imported(dataset, tmp_path / "out")[1][0]


@pytest.mark.parametrize(
    ("version", "stamp"), [("v2.1", 0.0), ("v3.0", 5.5), ("v3.0", None), ("v2.1", float("nan"))]
)
def test_rows_without_different_time_stamps_are_at_the_rate(version, stamp, tmp_path, caplog):
    film = write_film(tmp_path / "film.mp4")
    dataset = write_lerobot(tmp_path / "set", film, 24, version, stamps=[stamp] * 24)
    ((recording,), _) = imported(dataset, tmp_path / "out")
    assert numbers(recording.read_frames().frames) == [*range(24)]
    assert "does not separate 24 rows" in caplog.text


@pytest.mark.parametrize(
    ("fps", "start", "expected"),
    [
        (10, 0.0, [0, 3, 6, 9, 12]),
        (10, 0.3, [9, 12, 15, 18, 21]),
        (15, 2 / 30, [2, 4, 6, 8, 10]),
        (20, 0, [0, 2, 3, 5, 6]),  # of two frames equally near, the later one
        (60, 0.1, [3, 4, 4, 5, 5]),
        (30, 0.2, [6, 7, 8, 9, 10]),
        (29.97, 0.2, [6, 7, 8, 9, 10]),
    ],
)
def test_a_table_at_another_rate_takes_frames_by_time(fps, start, expected, tmp_path):
    film = write_film(tmp_path / "film.mp4")
    dataset = write_lerobot(tmp_path / "set", film, 5, "v3.0", fps=fps, starts=[start])
    ((recording,), problems) = imported(dataset, tmp_path / "out")
    assert not problems
    assert numbers(recording.read_frames().frames) == expected
    assert numbers(recording.clip(2, 5).read_frames(1).frames) == expected[3:]
    assert float(recording.fps) == pytest.approx(fps, abs=1e-3)


def test_29_97_and_30_drift_apart_by_a_frame_after_500(tmp_path):
    count = 560
    film = write_film(tmp_path / "a.mp4", [1001 * k for k in range(count)], rate=30, unit=NTSC)
    dataset = write_lerobot(tmp_path / "set", film, count, "v3.0")
    ((recording,), _) = imported(dataset, tmp_path / "out")
    found = np.array(numbers(recording.read_frames(495, 506).frames))
    moved = np.arange(495, 506) - (np.arange(495, 506) > 500)
    np.testing.assert_array_equal(found, moved % FRAMES)


@pytest.mark.parametrize(
    ("version", "stamps", "expected"),
    [
        ("v2.1", [0.2, 0.3, 0.4, 0.5], [6, 9, 12, 15]),
        ("v3.0", [0.1, 0.2, 0.3, None], [3, 6, 9]),
        ("v2.1", [0.1, 0.2, 0.2, 0.3], [3, 6, 9]),
        ("v3.0", [0.1, 0.2, 0.4, 0.5], [3, 6, 9, 12, 15]),
    ],
)
def test_the_time_stamps_of_a_table_win_over_its_rate(version, stamps, expected, tmp_path):
    film = write_film(tmp_path / "film.mp4")
    dataset = write_lerobot(tmp_path / "set", film, 4, version, stamps=stamps)
    ((recording,), problems) = imported(dataset, tmp_path / "out")
    assert not problems
    assert (recording.fps, numbers(recording.read_frames().frames)) == (10, expected)


def test_images_of_hot3d_are_taken_by_their_stamps(tmp_path, monkeypatch):
    monkeypatch.setattr(test_hot3d, "FRAMES", 7)
    times = iter([0, 1, 2, 4, 5, 6, 7])
    monkeypatch.setattr(
        "builtins.round",
        lambda x, *n, r=round: r(1e9 + next(times) * 1e9 / 30) if x >= 1e9 else r(x, *n),
    )
    test_hot3d.write_clip(tmp_path / "set/clip.tar")
    monkeypatch.undo()
    ((recording,), problems) = imported(Hot3D(source=tmp_path / "set"), tmp_path / "out")
    assert not problems
    assert (recording.frames, recording.fps) == (8, 30)
    assert recording.world_from_camera is not None
    steps = recording.world_from_camera[:, 0, 3] / 0.01
    np.testing.assert_allclose(steps, [0, 1, 2, 3, 3, 4, 5, 6], atol=1e-6)


def test_rows_without_time_stamps_are_refused():
    with pytest.raises(InputError, match="no time stamps"):
        row_times([None, "a", float("nan")], [], "table")


@pytest.mark.parametrize("rate", ["30", "24", "16", "10", "60000/1001", "30000/1001", "24000/1001"])
@pytest.mark.parametrize("unit", [1e-3, 1 / 90000])
def test_a_constant_rate_is_found_from_rounded_stamps(rate, unit):
    exact = Fraction(rate)
    stamps = [round(k / exact / Fraction(unit)) for k in range(200) if k not in (50, 51, 120)]
    timeline = Timeline.of(stamps, Fraction(unit), [Fraction(7)])
    assert (timeline.fps, timeline.count) == (exact, 200)


def test_no_frames_no_key_frame_and_repeated_stamps_have_their_own_messages(tmp_path, caplog):
    write_film(tmp_path / "cut.mkv", format="matroska", g="100", cut=1)
    with pytest.raises(InputError, match=r"no key frame.*ffmpeg -ss"):
        probe_video(tmp_path / "cut.mkv")
    write_film(tmp_path / "hidden.mp4", [stamp - 90_000 for stamp in EVEN])
    with pytest.raises(InputError, match=r"holds no frames\. Export"):
        probe_video(tmp_path / "hidden.mp4")
    FILMS["repeated stamp"][0](tmp_path / "twice.mkv")
    probe_video(tmp_path / "twice.mkv")
    assert "1 of 24 frames have the time stamp of another, the first one at 0.433 s" in caplog.text
