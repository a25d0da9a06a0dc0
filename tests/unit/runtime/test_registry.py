"""Parts by name: built in, registered, of a module, and of an entry point."""

import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from types import ModuleType

import pytest

from egosim_jax.runtime import registry
from egosim_jax.runtime.registry import Registry
from egosim_jax.types import InputError


@dataclass(frozen=True)
class Sized:
    size: int = 3


@pytest.fixture
def parts(monkeypatch):
    """Registry with a built-in part; the module `theirs` has others."""
    theirs = ModuleType("theirs")
    theirs.Sized, theirs.made, theirs.value = Sized, lambda: Sized(size=7), Sized(size=9)
    monkeypatch.setitem(sys.modules, "theirs", theirs)
    entry = EntryPoint("installed", "theirs:value", "egosim_jax.parts")
    monkeypatch.setattr(
        registry, "entry_points", lambda group: [entry] if group == entry.group else []
    )
    return Registry("part", "--part", "egosim_jax.parts", {"plain": "theirs:Sized"})


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("plain", 3),
        ("plain --size 4", 4),
        ("theirs:Sized --size 5", 5),
        ("theirs:made", 7),
        ("theirs:value", 9),
        ("installed", 9),
    ],
)
def test_a_part_is_made_from_its_name_and_options(parts, text, size):
    assert parts.parse(text) == Sized(size=size)


def test_a_registered_part_comes_before_a_built_in_one(parts):
    @parts.register("plain")
    @dataclass(frozen=True)
    class Mine:
        pass

    assert parts.parse("plain") == Mine()
    assert parts.names() == ("installed", "plain")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("plan", "Did you mean 'plain'"),
        ("nowhere:x", "cannot be imported"),
        (".theirs:x", "is relative"),
        ("theirs:x", "does not have it"),
        ("theirs:value --size 3", "has no options"),
        ("plain 'x", "not a name with options"),
    ],
)
def test_a_wrong_name_is_refused(parts, text, reason):
    with pytest.raises(InputError, match=rf"(?s){reason}.*\(--part\)"):
        parts.parse(text)
