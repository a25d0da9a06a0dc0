"""Defaults of models and recipes. To accept a change: `python -m tests.golden.test_configs`."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from egosim_jax import configs
from egosim_jax.train.recipes import RECIPES

FOLDER = Path(__file__).parent


def lines(value: Any, name: str) -> Iterator[str]:
    """Yield a line for each number, text or class below a value."""
    if dataclasses.is_dataclass(value):
        yield f"{name}: {type(value).__name__}"
        for field in dataclasses.fields(value):
            yield from lines(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from lines(item, f"{name}.{key}")
    else:
        yield f"{name} = {value!r}"


def models() -> Iterator[str]:
    for name in configs.names():
        yield from lines(configs.get(name), name)


def recipes() -> Iterator[str]:
    for name, (_, recipe) in RECIPES.items():
        yield from lines(recipe, name)


@pytest.mark.parametrize("dump", [models, recipes])
def test_no_default_changes_unseen(dump):
    golden = FOLDER / f"{dump.__name__}.txt"
    assert list(dump()) == golden.read_text("utf-8").splitlines()


if __name__ == "__main__":
    for dump in (models, recipes):
        text = "\n".join(dump()) + "\n"
        (FOLDER / f"{dump.__name__}.txt").write_text(text, encoding="utf-8")
