"""Pipelines by name: command line, and fingerprint of a run (`runtime` has all other names)."""

from dataclasses import FrozenInstanceError

import pytest

from egosim_jax.io.digest import fingerprint
from egosim_jax.perception import Observation, Pipeline, registry
from egosim_jax.types import InputError

BUILT_IN = {"classical": "", "oracle": "", "recorded": " --folder x --name clip"}


@pytest.mark.parametrize(("name", "options"), BUILT_IN.items())
def test_every_pipeline_is_built_from_a_command_line(name, options):
    config = registry.parse(name + options)
    assert isinstance(config, registry.get(name))
    assert isinstance(config.build({0: Observation()}), Pipeline)
    with pytest.raises(FrozenInstanceError):
        config.anything = 1


def test_each_threshold_is_an_option():
    config = registry.parse("classical --motion.evidence 12 --hands.discs 9")
    assert (config.motion.evidence, config.hands.discs) == (12, 9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--hands.discs 0", "discs must be at least 1"),
        ("--motion.blur-px 0", "blur_px must be positive"),
        ("--motion.refinement.deviation-m 0", "deviation_m must be positive, or None"),
        ("--motion.refinement.steps-m 0.01", "one step per round"),
    ],
)
def test_an_invalid_threshold_is_refused(options, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        registry.parse(f"classical {options}")
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_changed_threshold_changes_the_fingerprint_of_the_pipeline():
    texts = ["classical", "classical --motion.color.max-residual 91", "classical --hands.discs 9"]
    prints = [fingerprint(registry.parse(text).build()) for text in texts]
    assert len(set(prints)) == 3
    assert prints[0] == fingerprint(registry.parse("classical").build())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clasical", "classical, networks, oracle, recorded"),
        ("", "classical, networks, oracle, recorded"),
        ("oracle", "'oracle' needs ground truth"),
    ],
)
def test_what_is_no_pipeline_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        registry.parse(text).build({})
