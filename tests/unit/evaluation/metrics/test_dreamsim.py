"""The adapter to the package dreamsim, with networks that embed the mean color."""

import sys
import types

import numpy as np
import pytest
import torch

from egosim_jax.evaluation.metrics.dreamsim import FILES, MAX_FRAMES, DreamSim
from egosim_jax.types import InputError


@pytest.fixture
def folder(tmp_path):
    """Files of the release, without weights."""
    (tmp_path / "ensemble_lora").mkdir()
    for name in FILES:
        (tmp_path / name).write_text(name)
    return tmp_path


def package(folder):
    """Return a package that embeds the mean color, without its mean."""
    sizes = []

    def embed(images):
        sizes.append(len(images))
        colors = images.mean(dim=(2, 3))
        return colors - colors.mean(dim=1, keepdim=True)

    def prepare(image):
        return torch.from_numpy(np.array(image)).permute(2, 0, 1)[None] / 255

    def dreamsim(*, cache_dir, device):
        assert cache_dir == str(folder)
        print("Using cached weights")
        return types.SimpleNamespace(embed=embed), prepare

    return types.SimpleNamespace(
        dreamsim=dreamsim, sizes=sizes, __spec__=types.SimpleNamespace(name="dreamsim")
    )


def test_frames_are_embedded_in_batches_and_compared_by_angle(folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "dreamsim", module := package(folder))
    network = DreamSim(folder)
    assert not capsys.readouterr().out  # stdout is for results
    frames = np.zeros((MAX_FRAMES + 1, 4, 6, 3), np.uint8)
    frames[..., 0] = 200
    other = frames[..., ::-1].copy()
    embedded = network.embed(frames)
    assert module.sizes == [MAX_FRAMES, 1]
    np.testing.assert_allclose(network.distances(embedded, embedded), 0, atol=1e-6)
    np.testing.assert_allclose(network.distances(embedded, network.embed(other)), 1.5, atol=1e-6)
    assert set(network.hashes) == {name.split("/")[-1] for name in FILES}


def test_a_folder_without_a_network_is_refused(folder):
    (folder / FILES[1]).unlink()
    with pytest.raises(InputError, match=r"clip_vitb16_pretrain\.pth\.tar.*--dreamsim"):
        DreamSim(folder)
