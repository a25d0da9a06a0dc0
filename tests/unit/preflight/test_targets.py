"""Targets: names, data sheets, and errors for unknown ones."""

import importlib.util
import math
import os

import pytest

from egosim_jax.preflight import targets
from egosim_jax.preflight.report import parse_oom
from egosim_jax.preflight.targets import (
    DEVICES,
    GIB,
    OFFLINE_ENV,
    Target,
    compile_offline,
    find,
    parse,
    peak,
)
from egosim_jax.types import InputError
from tests.machines import MACHINES


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("h20:8", "Nearest device: h200"),
        ("h200", "h200:8"),
        ("h200:0", "h200:8"),
        ("h200:2x4", "a number"),
        ("v6e:16", "a slice"),
        ("v6e:4x0", "a slice"),
    ],
)
def test_an_unknown_target_is_refused_with_the_nearest_or_with_the_form(name, message):
    with pytest.raises(InputError, match=message):
        parse(name)


@pytest.mark.parametrize(("name", "extra"), [("h200:8", "cuda"), ("v5p:2x2x2", "tpu")])
def test_a_compiler_that_is_missing_is_named_with_its_extra(name, extra, monkeypatch):
    monkeypatch.setattr(targets, "find_spec", lambda module: None)
    with pytest.raises(InputError, match=rf"egosim-jax\[{extra}\]"):
        find(name)


def test_more_processors_than_available_are_refused_with_the_flag():
    with pytest.raises(InputError, match="device_count=99"):
        find("cpu:99")


def test_finding_a_target_changes_nothing_of_the_process(monkeypatch):
    for variable in OFFLINE_ENV:
        monkeypatch.delenv(variable, raising=False)
    find("cpu:1")
    assert not OFFLINE_ENV.keys() & os.environ.keys()


def test_the_longest_matching_kind_counts():
    assert peak("TPU v5 lite") == 197e12
    assert peak("TPU v5p") == peak("TPU v5") == 459e12
    assert math.isnan(peak("cpu"))


@pytest.mark.parametrize(
    ("message", "needs"),
    [
        ("RESOURCE_EXHAUSTED: Used 44.01G of 31.25G hbm. Exceeded by 12.76G", 44.01),
        ("required for HLO temporaries (400.00G) exceeds available HBM (31.25G).", 400),
    ],
)
def test_out_of_memory_messages_are_parsed(message, needs):
    target = Target(name="v6e:2x2", device=DEVICES["v6e"], devices=())
    report = parse_oom(RuntimeError(message), target)
    assert not report.fits
    assert report.needs == pytest.approx(needs * GIB)
    assert report.capacity == 31.25 * GIB


def test_another_error_of_a_compiler_stays_one():
    target = Target(name="v6e:2x2", device=DEVICES["v6e"], devices=())
    with pytest.raises(RuntimeError, match="broken"):
        parse_oom(RuntimeError("broken"), target)


COMPILERS = {
    "jax_cuda13_plugin": {"h200:8": 8, "b200:1": 1, "h200:16": 16, "b200:72": 72},
    "libtpu": {"v5p:2x2x2": 8, "v6e:4x4": 16, "v5e:4x4": 16, "v5e:8x8": 64, "v5p:4x4x4": 64},
}
INSTALLED = [c for module, c in COMPILERS.items() if importlib.util.find_spec(module)]


@pytest.mark.parametrize(
    ("name", "devices"), [("cpu:1", 1), *(item for c in INSTALLED for item in c.items())]
)
def test_a_target_has_its_devices(name, devices):
    """Also of GPUs and TPUs where their compilers are installed: the extras `cuda` and `tpu`."""
    compile_offline()
    target = find(name)
    assert len(target.devices) == devices
    assert all(device.device_kind.startswith(target.device.kind) for device in target.devices)
    if (imitated := MACHINES.get(name)) is not None:
        for real, ours in zip(target.devices, imitated, strict=True):
            assert (real.id, real.process_index) == (ours.id, ours.process_index)
            assert ours.platform == "gpu" or tuple(real.coords) == ours.coords
