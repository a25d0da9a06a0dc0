"""`egosim-convert`: a foreign checkpoint to a weights folder."""

import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file, save_file

from egosim_jax import configs
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.tables import clip_vision
from egosim_jax.io.weights import translate_back
from egosim_jax.models.clip_vision import CLIPVision

CONFIG = configs.get("debug")


@pytest.fixture(scope="module")
def theirs() -> dict[str, np.ndarray]:
    """The image encoder of `debug` in official names."""
    shapes = nnx.state(nnx.eval_shape(lambda: CLIPVision(CONFIG.image, rngs=nnx.Rngs(0))))
    rng = np.random.default_rng(0)
    ours = {
        ".".join(map(str, path)): rng.normal(size=leaf.shape).astype(np.float32)
        for path, leaf in nnx.to_flat_state(shapes)
    }
    return {
        name: np.ascontiguousarray(tensor)
        for name, tensor in translate_back(ours, clip_vision.wan(CONFIG.image)).items()
    }


def convert(source, out) -> int:
    options = {"config": "debug", "network": "image", "layout": "wan", "source": source, "out": out}
    return main(["weights", *(str(x) for k, v in options.items() for x in (f"--{k}", v))])


def test_a_foreign_file_becomes_a_file_of_a_weights_folder(theirs, tmp_path):
    save_file(theirs, tmp_path / "clip.safetensors")
    assert convert(tmp_path / "clip.safetensors", tmp_path / "weights") == 0
    ours = load_file(tmp_path / "weights" / "image.safetensors")
    back = translate_back(ours, clip_vision.wan(CONFIG.image))
    assert back.keys() == theirs.keys()
    assert all(np.array_equal(back[name], theirs[name]) for name in theirs)


def test_a_file_that_lacks_tensors_is_refused_with_their_names(theirs, tmp_path, capsys):
    less = {name: tensor for name, tensor in theirs.items() if "pre_norm" not in name}
    save_file(less, tmp_path / "clip.safetensors")
    assert convert(tmp_path / "clip.safetensors", tmp_path / "weights") == 2
    message = capsys.readouterr().err
    assert "visual.pre_norm.weight" in message
    assert "visual.pre_norm.bias" in message
    assert not (tmp_path / "weights").exists()


def test_inspect_lists_every_tensor(theirs, tmp_path, capsys):
    save_file(theirs, tmp_path / "clip.safetensors")
    assert main(["inspect", "--source", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert len(captured.out.splitlines()) == len(theirs)
    assert f"{sum(tensor.size for tensor in theirs.values()):,} weights" in captured.err
