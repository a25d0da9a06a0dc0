"""Depth Anything V2 in its worker gives the depth of transformers; the caller needs no torch."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from egosim_jax.perception.networks.depth_anything import DepthAnything
from egosim_jax.perception.networks.worker import close_workers
from egosim_jax.types import InputError
from tests.unit.perception.networks import tiny
from tests.unit.perception.posed import UNKNOWN_CAMERAS

FRAMES = np.random.default_rng(0).integers(0, 256, (3, 48, 80, 3)).astype(np.uint8)
STILL = np.zeros(FRAMES.shape[:3], bool)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    yield tiny.depth_anything(tmp_path_factory.mktemp("depth_anything"))
    close_workers()


@pytest.mark.slow
def test_depth_is_that_of_transformers_own_pipeline(folder):
    import transformers as hf

    network = hf.DepthAnythingForDepthEstimation.from_pretrained(folder)
    processor = hf.DPTImageProcessorPil.from_pretrained(folder)
    inputs = processor(images=[FRAMES[2], FRAMES[0]], return_tensors="pt")
    with torch.inference_mode():
        output = network(**inputs)
    want = processor.post_process_depth_estimation(output, [(48, 80)] * 2)
    want = np.stack([one["predicted_depth"].numpy() for one in want])

    found = DepthAnything(folder, batch=1)(FRAMES, STILL, UNKNOWN_CAMERAS, [2, 0])

    assert found.frames.tolist() == [2, 0]
    assert found.metric
    assert found.confident.all()
    assert np.ptp(want) > 1
    np.testing.assert_allclose(found.depth_m, want, rtol=1e-4)


@pytest.mark.slow
def test_a_missing_device_is_refused(folder):
    with pytest.raises(InputError, match=r"no device 'cuda:7'.*--device"):
        DepthAnything(folder, device="cuda:7")(FRAMES, STILL, UNKNOWN_CAMERAS, [0])


@pytest.mark.slow
def test_the_calling_process_never_imports_torch(folder):
    code = (
        "import sys, numpy as np\n"
        "from egosim_jax.perception.networks.depth_anything import DepthAnything\n"
        "frames = np.zeros((1, 28, 28, 3), np.uint8)\n"
        f"found = DepthAnything(__import__('pathlib').Path({str(folder)!r}))(\n"
        "    frames, frames[..., 0] > 0, None, [0])\n"
        "print(found.depth_m.shape, *(name in sys.modules for name in ('torch', 'transformers')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stdout.decode().strip() == "(1, 28, 28) False False"
