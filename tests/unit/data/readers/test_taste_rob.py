"""TASTE-Rob: rows of tables that name no video, or one elsewhere."""

import pytest

from egosim_jax.data.readers.taste_rob import TasteRob
from egosim_jax.types import InputError


def test_rows_that_leave_the_folder_or_lack_a_video_are_named(world, tmp_path, imported):
    world.write_video(tmp_path / "a.mp4")
    world.write_video(tmp_path / "set/b.mp4")
    rows = "\n".join(["../a.mp4,x", f"{tmp_path}/a.mp4,x", "c.mp4,x", "b.mp4,x", ""])
    (tmp_path / "set/list.csv").write_text(f"video,prompt\n{rows}")
    done, problems = imported(TasteRob(source=tmp_path / "set"))
    assert list(done) == ["b"]
    assert sum("inside the dataset's folder" in problem for problem in problems.values()) == 2
    assert "cannot be read" in problems["c"]


def test_a_table_without_captions_is_refused(tmp_path):
    (tmp_path / "list.csv").write_text("video,score\na.mp4,1\n")
    with pytest.raises(InputError, match="one of caption"):
        list(TasteRob(source=tmp_path).find())
