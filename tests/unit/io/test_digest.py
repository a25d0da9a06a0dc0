"""Equal content has equal hashes, other content has others."""

import functools
from dataclasses import dataclass

import numpy as np
import pytest

from egosim_jax.io.digest import fingerprint, sha256, sha256_within


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
    assert sha256_within(folder / "a") == sha256(folder / "a")


@dataclass(frozen=True)
class Config:
    rate: float
    name: str = "a"


class Scaled:
    def __init__(self, scale):
        self.scale = scale

    def __call__(self, x):
        return self.scale * x


def maker(scale):
    def scaled(x):
        return scale * x

    return scaled


def test_equal_content_has_one_fingerprint():
    pairs = [
        (Config(1.0), Config(1.0)),
        ({"a": 1, "b": [2, None]}, {"b": [2, None], "a": 1}),
        (np.arange(6).reshape(2, 3), np.arange(6).reshape(2, 3)),
        (maker(2), maker(2)),
        (Scaled(2), Scaled(2)),
        (functools.partial(maker, 2), functools.partial(maker, 2)),
    ]
    for a, b in pairs:
        assert fingerprint(a) == fingerprint(b)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (Config(1.0), Config(2.0)),
        (0, 0.0),
        (0, False),
        ("ab", ["a", "b"]),
        ([["a"], "b"], [["a", "b"]]),
        (np.zeros(4), np.zeros((2, 2))),
        (np.zeros(4), np.zeros(4, np.float32)),
        (maker(2), maker(3)),
        (Scaled(2), Scaled(3)),
        (len, sum),
        (lambda x: x, lambda x: -x),
    ],
)
def test_other_content_has_another(a, b):
    assert fingerprint(a) != fingerprint(b)


def test_what_contains_itself_ends():
    loop: list = []
    loop.append(loop)
    assert fingerprint(loop) == fingerprint(loop)
