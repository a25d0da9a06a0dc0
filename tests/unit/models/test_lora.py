"""Low-rank additions by the names of their layers."""

import numpy as np

from egosim_jax.models.lora import Delta, from_tensors, tensors


def test_summands_of_layers_that_are_called_up_and_down_are_read_back():
    deltas = {
        path: Delta(down=np.full((3, 1), number), up=np.full((1, 2), -number))
        for number, path in zip((1.0, 2.0, 3.0), ("mlp.down", "mlp.up", "attention.q"), strict=True)
    }
    back = from_tensors(tensors(deltas))
    assert back.keys() == deltas.keys()
    for path, delta in deltas.items():
        assert (back[path].down == delta.down).all()
        assert (back[path].up == delta.up).all()
