"""Hashes of folders."""

from egosim_jax.io.digest import sha256, sha256_within


def test_the_hash_of_a_folder_is_of_the_names_and_bytes_of_its_files(tmp_path):
    found = []
    for number, (name, data) in enumerate((("a", "1"), ("a", "2"), ("b", "1"), ("a", "1"))):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / name).write_text(data)
        (folder / ".journal").write_text(str(number))
        found.append(sha256_within(folder))
    assert found[3] == found[0]
    assert len({*found}) == 3


def test_the_hash_of_a_file_is_that_of_its_bytes(tmp_path):
    (tmp_path / "a").write_text("1")
    assert sha256_within(tmp_path / "a") == sha256(tmp_path / "a")
