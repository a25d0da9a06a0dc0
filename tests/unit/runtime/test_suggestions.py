"""Suggestions for a mistyped option come from the command that was given."""

import pytest

from egosim_jax.cli.__main__ import main


@pytest.mark.parametrize(
    ("args", "wanted", "other"),
    [
        (["serve", "--prot", "3"], "--port", "--prompt"),
        (["simulate", "--seeed", "3"], "--seed", "in egosim"),
        (["play", "--perseption", "x"], "--perception", "in egosim"),
        (["data", "annotate", "v.mp4", "--out", "o", "--min-hand", "1"], "--min-hands", "generate"),
        (["data", "import", "lerobot", "x", "--out", "o", "--fpss", "3"], "lerobot", "nerfstudio"),
    ],
    ids=lambda value: " ".join(value[:3]) if isinstance(value, list) else value,
)
def test_an_unknown_option_is_compared_with_those_of_its_command(args, wanted, other, capsys):
    with pytest.raises(SystemExit) as ended:
        main(args)
    captured = capsys.readouterr()
    text = captured.out + captured.err
    assert ended.value.code == 2
    assert wanted in text
    assert other not in text
