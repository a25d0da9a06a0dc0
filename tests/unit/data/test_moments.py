"""Caches of moments: torch reads our files, and we read torch's."""

import numpy as np
import pytest
import torch

from egosim_jax.data.moments import cache_of, check_alike, read_moments, read_tensor, write_moments
from egosim_jax.io.untrusted.pth import read_pth, write_pth
from egosim_jax.types import InputError

SHAPE = (3, 4, 6, 16)


@pytest.fixture
def moments():
    rng = np.random.default_rng(0)
    return (rng.normal(size=SHAPE).astype(np.float32) for _ in range(2))


def test_torch_loads_written_moments_with_weights_only(tmp_path, moments):
    mean, logvar = moments
    path = tmp_path / "a" / "00001.pt"
    path.parent.mkdir()
    write_moments(path, mean, logvar)
    loaded = torch.load(path, weights_only=True)
    assert loaded.dtype == torch.bfloat16
    assert tuple(loaded.shape) == (32, 3, 4, 6)
    expected = torch.from_numpy(np.concatenate([mean, logvar], -1)).permute(3, 0, 1, 2)
    assert torch.equal(loaded, expected.to(torch.bfloat16))
    again = read_moments(path, SHAPE)
    assert np.abs(again[0] - mean).max() < 0.02
    assert np.abs(again[1] - logvar).max() < 0.02


def test_moments_of_torch_are_read(tmp_path, moments):
    mean, logvar = moments
    tensor = torch.from_numpy(np.concatenate([mean, logvar], -1)).permute(3, 0, 1, 2)
    torch.save(tensor.to(torch.bfloat16).contiguous(), tmp_path / "a.pt")
    got = read_moments(tmp_path / "a.pt", SHAPE)
    np.testing.assert_array_equal(
        got[0], tensor[:16].to(torch.bfloat16).float().permute(1, 2, 3, 0)
    )
    np.testing.assert_array_equal(
        got[1], tensor[16:].to(torch.bfloat16).float().permute(1, 2, 3, 0)
    )


@pytest.mark.parametrize("dtype", ["float32", "float16", "int64", "uint8"])
def test_tensors_of_other_dtypes_are_written(tmp_path, dtype):
    array = np.arange(24).reshape(2, 3, 4).astype(dtype)
    write_pth(tmp_path / "a.pt", array)
    np.testing.assert_array_equal(torch.load(tmp_path / "a.pt", weights_only=True).numpy(), array)
    np.testing.assert_array_equal(read_pth(tmp_path / "a.pt")[""].array(), array)


def test_other_shapes_and_values_are_refused(tmp_path):
    write_pth(tmp_path / "a.pt", np.zeros((32, 3, 4, 5), np.float32))
    with pytest.raises(InputError, match=r"one tensor of \(32, 3, 4, 6\).*not resized"):
        read_moments(tmp_path / "a.pt", SHAPE)
    write_pth(tmp_path / "b.pt", np.full((2, 3), np.nan, np.float32))
    with pytest.raises(InputError, match="not finite"):
        read_tensor(tmp_path / "b.pt", (2, 3))


def test_latents_of_another_vae_are_refused(tmp_path, moments):
    mean, other = moments
    rounded = torch.from_numpy(mean).to(torch.bfloat16).float().numpy()
    check_alike(tmp_path / "a.pt", rounded, mean)
    for wrong in (other, 1.2 * mean, np.roll(mean, 1, axis=1)):
        with pytest.raises(InputError, match=r"made with other weights.*--weights"):
            check_alike(tmp_path / "a.pt", wrong, mean)


def test_caches_are_next_to_the_videos(tmp_path):
    video = tmp_path / "home" / "videos" / "00001.mp4"
    assert cache_of(video, "prior") == tmp_path / "home" / "static_video_latents" / "00001.pt"
