"""Targets: their names, what is known of them, and what is said of those that are not."""

import importlib.util
import math

import pytest

from egosim_jax.preflight import targets
from egosim_jax.preflight.report import refusal
from egosim_jax.preflight.targets import DEVICES, GIB, Target, find, parse, peak
from egosim_jax.types import InputError


@pytest.mark.parametrize("name", ["h200:8", "h100:1", "b200:8", "v5p:2x2x2", "v6e:4x4", "cpu:1"])
def test_a_target_is_a_device_and_a_size(name):
    assert ":".join(parse(name)) == name


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("h20:8", "Nearest device: h200"),
        ("h200", "h200:8"),
        ("h200:0", "h200:8"),
        ("h200:2x4", "a number"),
        ("v6e:16", "a slice"),
        ("v6e:4x0", "a slice"),
    ],
)
def test_another_name_is_refused_with_the_nearest_or_with_the_form(name, said):
    with pytest.raises(InputError, match=said):
        parse(name)


@pytest.mark.parametrize(("name", "extra"), [("h200:8", "cuda"), ("v5p:2x2x2", "tpu")])
def test_a_compiler_that_is_missing_is_named_with_its_extra(name, extra, monkeypatch):
    monkeypatch.setattr(targets, "find_spec", lambda module: None)
    with pytest.raises(InputError, match=rf"egosim-jax\[{extra}\]"):
        find(name)


def test_more_processors_than_there_are_are_refused_with_the_flag():
    with pytest.raises(InputError, match="device_count=99"):
        find("cpu:99")


def test_every_device_has_its_facts():
    for device in DEVICES.values():
        facts = (device.flops, device.memory, device.bandwidth, device.link)
        assert all(map(math.isfinite, facts))
        assert (device.chip is None) == (device.platform == "tpu")
        # In the units that are said: from the slowest TPU to the fastest GPU.
        assert 1e14 < device.flops < 1e16
        assert 1e10 < device.memory < 1e12
        assert 5e11 < device.bandwidth < 1e13
        assert 1e11 <= device.link < device.bandwidth


def test_the_longest_beginning_of_a_kind_counts():
    assert peak("TPU v5 lite") == 197e12
    assert peak("TPU v5p") == peak("TPU v5") == 459e12
    assert math.isnan(peak("cpu"))


@pytest.mark.parametrize(
    ("said", "needs"),
    [
        ("RESOURCE_EXHAUSTED: Used 44.01G of 31.25G hbm. Exceeded by 12.76G", 44.01),
        ("required for HLO temporaries (400.00G) exceeds available HBM (31.25G).", 400),
    ],
)
def test_what_a_compiler_says_of_memory_is_understood(said, needs):
    target = Target(name="v6e:2x2", device=DEVICES["v6e"], devices=())
    report = refusal(RuntimeError(said), target)
    assert not report.fits
    assert report.needs == pytest.approx(needs * GIB)
    assert report.capacity == 31.25 * GIB


def test_another_error_of_a_compiler_stays_one():
    target = Target(name="v6e:2x2", device=DEVICES["v6e"], devices=())
    with pytest.raises(RuntimeError, match="broken"):
        refusal(RuntimeError("broken"), target)


COMPILERS = {
    "jax_cuda13_plugin": {"h200:8": 8, "b200:1": 1},
    "libtpu": {"v5p:2x2x2": 8, "v6e:4x4": 16},
}
INSTALLED = [c for module, c in COMPILERS.items() if importlib.util.find_spec(module)]


@pytest.mark.parametrize(
    ("name", "devices"), [("cpu:1", 1), *(item for c in INSTALLED for item in c.items())]
)
def test_a_target_has_its_devices(name, devices):
    """Also of GPUs and TPUs where their compilers are installed: the extras `cuda` and `tpu`."""
    target = find(name)
    assert len(target.devices) == devices
    assert all(device.device_kind.startswith(target.device.kind) for device in target.devices)
