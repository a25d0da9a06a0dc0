"""Files are whole or absent."""

import pytest

from egosim_jax.io.whole import whole


def test_a_file_has_its_name_when_all_is_written(tmp_path):
    path = tmp_path / "new" / "picture.png"
    with whole(path) as temporary:
        assert temporary.suffix == ".png"
        temporary.write_text("half", encoding="utf-8")
        assert not path.exists()
        temporary.write_text("whole", encoding="utf-8")
    assert path.read_text("utf-8") == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_after_an_error_the_older_file_stays_and_nothing_else(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("older", encoding="utf-8")
    with pytest.raises(UnicodeEncodeError), whole(path) as temporary:
        temporary.write_text("half \ud800", encoding="utf-8")
    assert path.read_text("utf-8") == "older"
    assert list(tmp_path.iterdir()) == [path]
