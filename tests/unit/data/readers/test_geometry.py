"""Every reader of videos takes the track, the pixels and the colors that a video's file says."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from egosim_jax.data.readers.agibot import AgiBot
from egosim_jax.data.readers.egodex import EgoDex
from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.egovid import EgoVid
from egosim_jax.data.readers.lerobot import LeRobot
from egosim_jax.data.readers.taste_rob import TasteRob
from tests.captures import World
from tests.unit.data.readers import test_agibot as agibot
from tests.unit.data.readers import test_egodex as egodex
from tests.unit.data.readers import test_egosim as egosim
from tests.unit.data.readers import test_egovid as egovid
from tests.unit.data.readers import test_lerobot as lerobot


class Shown(World):
    """A scene whose videos need their file's description to be read right."""

    kind = "plain"

    def write_video(self, path, *, fps=30, codec="libx264", repeat=1):
        path.parent.mkdir(parents=True, exist_ok=True)
        aspect = Fraction(4, 3) if self.kind == "aspect" else Fraction(1)
        size = round(self.width / aspect), self.height
        stored = [cv2.resize(f, size, interpolation=cv2.INTER_AREA) for f in self.video] * repeat
        with av.open(str(path), "w") as container:
            streams = {}
            if self.kind == "default-track":
                streams["other"] = container.add_stream("libx264", rate=Fraction(fps))
                streams["other"].width, streams["other"].height = 64, 48
                streams["other"].disposition = Disposition(0)
            stream = container.add_stream(codec, rate=Fraction(fps))
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            stream.options = {"crf": "12"} | ({"preset": "12"} if codec == "libsvtav1" else {})
            stream.codec_context.sample_aspect_ratio = aspect
            if self.kind == "hdr":
                stream.codec_context.color_trc = 16
            if self.kind == "default-track":
                stream.disposition = Disposition.default
            for frame in stored:
                if "other" in streams:
                    gray = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 90, np.uint8))
                    container.mux(streams["other"].encode(gray))
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            for each in (*streams.values(), stream):
                container.mux(each.encode())
        return path


def write_taste_rob(root, world):
    world.write_video(root / "a.mp4")
    (root / "list.csv").write_text("video,caption\na.mp4,A hand.\n")


READERS = {
    "lerobot-v2": (LeRobot, lerobot.write_v2),
    "lerobot-v3": (LeRobot, lerobot.write_v3),
    "egodex": (EgoDex, lambda root, world: egodex.write_episode(world, root / "0.hdf5")),
    "egovid": (EgoVid, egovid.write_set),
    "agibot": (AgiBot, agibot.write_episode),
    "egosim": (EgoSimClips, lambda root, world: egosim.write_clip(root / "fold_1", world)),
    "taste_rob": (TasteRob, write_taste_rob),
}
AMBIGUOUS = ("agibot", "egosim")
"""Readers whose intrinsics may be for stored or for square pixels."""


@pytest.mark.parametrize("kind", ["plain", "default-track", "aspect", "hdr"])
@pytest.mark.parametrize("name", READERS)
def test_a_reader_takes_videos_as_their_files_say(tmp_path, imported, name, kind):
    world = Shown(frames=20, height=240, width=320) if name == "egovid" else Shown()
    if name == "egovid":
        world.render_plane()
    world.kind = kind
    reader, write = READERS[name]
    write(tmp_path / "set", world)
    done, problems = imported(reader(source=tmp_path / "set"))
    problem = " ".join(problems.values())
    if kind == "hdr":
        assert not done
        assert "PQ" in problem
        assert "ffmpeg -i IN" in problem
    elif kind == "aspect" and name in AMBIGUOUS:
        assert not done
        assert "setsar=1" in problem
    else:
        recording = next(iter(done.values()))
        assert (recording.height, recording.width) == (world.height, world.width)
        frames = recording.read_frames(0, 3).frames
        assert np.abs(frames.astype(float) - world.video[:3]).mean() < 12  # noise of one pixel
        if recording.intrinsics_px is not None:
            np.testing.assert_allclose(recording.intrinsics_px, world.intrinsics, atol=1e-4)
