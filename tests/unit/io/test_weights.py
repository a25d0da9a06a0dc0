"""Weights in our own format."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from flax import nnx

from egosim_jax.io import weights
from egosim_jax.io.weights import WeightsError
from egosim_jax.models.layers import Linear, RMSNorm, stack
from egosim_jax.types import InputError
from tests.flags import devices


class Net(nnx.Module):
    def __init__(self, *, rngs: nnx.Rngs):
        self.head = Linear(3, 2, axes=("embed", "mlp"), rngs=rngs)
        self.blocks = stack(lambda _: RMSNorm(3, eps=1e-6), 2, rngs=rngs)


def skeleton() -> Net:
    return nnx.eval_shape(lambda: Net(rngs=nnx.Rngs(0)))


def test_a_saved_network_loads_into_a_skeleton_bit_for_bit(tmp_path):
    net, path = Net(rngs=nnx.Rngs(1)), tmp_path / "net.safetensors"
    weights.save(path, net)
    copy = skeleton()
    weights.load(path, copy)
    np.testing.assert_array_equal(copy.head.kernel[...], net.head.kernel[...])
    assert [file.name for file in tmp_path.iterdir()] == ["net.safetensors"]
    weights.save(path, net, dtype="float16")
    weights.load(path, half := skeleton())
    assert half.head.kernel[...].dtype == np.float16
    np.testing.assert_allclose(half.head.kernel[...], net.head.kernel[...], rtol=1e-3)
    assert net.head.kernel[...].dtype == np.float32


def test_weights_that_do_not_fit_are_refused(tmp_path):
    net, path = Net(rngs=nnx.Rngs(0)), tmp_path / "net.safetensors"
    with pytest.raises(InputError, match="--weights"):
        weights.load(path, skeleton())
    net.head = Linear(3, 5, axes=("embed", "mlp"), rngs=nnx.Rngs(0))
    weights.save(path, net)
    with pytest.raises(WeightsError, match=r"head\.kernel: has shape \(3, 5\); expected \(3, 2\)"):
        weights.load(path, skeleton())
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(InputError, match="not a readable safetensors file"):
        weights.load(path, skeleton())


def test_weights_can_be_read_by_whoever_the_umask_allows(tmp_path):
    umask = os.umask(0o022)
    try:
        weights.save(tmp_path / "a.safetensors", Net(rngs=nnx.Rngs(0)))
    finally:
        os.umask(umask)
    assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == 0o644


def test_each_device_reads_its_part_of_a_folder(tmp_path):
    """Eight devices share the width of a kernel; the file has half the precision."""
    code = """
import sys
from pathlib import Path
import jax, numpy as np
from flax import nnx
from egosim_jax.io import weights
from egosim_jax.models.layers import Linear
from egosim_jax.sharding import make_mesh, state_sharding
from egosim_jax.types import MeshConfig

class Net(nnx.Module):
    def __init__(self):
        self.dit = Linear(16, 4, axes=("embed", "mlp"), rngs=nnx.Rngs(0))

folder = Path(sys.argv[1])
net = Net()
weights.save(folder / "dit.safetensors", net.dit, dtype="float16")
abstract = nnx.state(nnx.eval_shape(Net), nnx.Param)
sharding = state_sharding(make_mesh(MeshConfig()), abstract)
placed = weights.place(folder, abstract, sharding)
kernel = placed["dit"]["kernel"].get_value()
assert kernel.dtype == np.float32
assert {shard.data.shape for shard in kernel.addressable_shards} == {(2, 4)}
np.testing.assert_array_equal(kernel, np.float16(net.dit.kernel.get_value()))
assert jax.tree.structure(placed) == jax.tree.structure(abstract)
"""
    environment = os.environ | devices(8)
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=environment, check=True)
    weights.save(tmp_path / "dit.safetensors", Net(rngs=nnx.Rngs(0)))
    other = nnx.State({"dit": nnx.state(skeleton().blocks)})
    with pytest.raises(WeightsError, match=r"head\.kernel: unexpected, with shape \(3, 2\)"):
        weights.place(tmp_path, other, other)


def folders(tmp_path):
    """A base of two networks, and the folder of a run that trained one of them."""
    base, run = tmp_path / "base", tmp_path / "run" / "weights"
    for seed, name in enumerate(("dit", "vae")):
        weights.save(base / f"{name}.safetensors", Net(rngs=nnx.Rngs(seed)))
    (base / "google").mkdir()
    (base / "google" / "spiece.model").write_text("tokens", encoding="utf-8")
    weights.save(run / "dit.safetensors", Net(rngs=nnx.Rngs(5)))
    weights.add_others(run, base)
    return base, run


def test_a_runs_folder_is_complete_after_it_was_copied_and_its_base_removed(tmp_path):
    base, run = folders(tmp_path)
    want = {"dit": weights.hashes(run)["dit"], "vae": weights.hashes(base)["vae"]}
    weights.save(base / "vae.safetensors", Net(rngs=nnx.Rngs(8)))  # another file in its place
    assert weights.hashes(run) == want
    copy = shutil.copytree(run, tmp_path / "copy", symlinks=True)
    shutil.rmtree(base)
    shutil.rmtree(run)
    assert weights.hashes(copy) == want
    assert (copy / "google" / "spiece.model").read_text(encoding="utf-8") == "tokens"
    assert not any(path.is_symlink() for path in copy.rglob("*"))


@pytest.mark.parametrize("where", ["base", "run"])
def test_a_network_that_was_replaced_is_refused(tmp_path, where):
    base, run = folders(tmp_path)
    weights.save(tmp_path / "other.safetensors", Net(rngs=nnx.Rngs(8)))
    # In place, as `cp` writes.
    at = (base if where == "base" else run) / "vae.safetensors"
    at.write_bytes((tmp_path / "other.safetensors").read_bytes())
    for read in (weights.hashes, lambda folder: weights.check_record(folder, ["vae"])):
        with pytest.raises(InputError, match=r"vae\.safetensors has the hash .*was replaced"):
            read(run)
    assert weights.hashes(run, only=["dit"]).keys() == {"dit"}
    weights.check_record(run, ["dit"])


def test_a_stopped_copy_is_finished_and_copies_on_another_disk(tmp_path, monkeypatch):
    base, run = folders(tmp_path)
    want = weights.hashes(run)
    (run / "vae.safetensors").unlink()
    monkeypatch.setattr(os, "link", lambda *_: os.stat(tmp_path / "nothing"))
    weights.add_others(run, base)
    assert weights.hashes(run) == want
    assert not (run / "vae.safetensors").samefile(base / "vae.safetensors")


def test_a_link_to_nothing_names_its_target(tmp_path):
    for name in ("dit.safetensors", weights.STUDENT):
        (tmp_path / name).symlink_to(tmp_path / "gone.safetensors")
    for read in (
        weights.hashes,
        lambda folder: weights.check_folder(folder, "debug"),
        lambda folder: weights.load(folder / "dit.safetensors", skeleton()),
        lambda folder: weights.student_of(folder / "dit.safetensors", {"chunks": "1"}),
    ):
        with pytest.raises(InputError, match=r"is a link to .*gone\.safetensors, which does not"):
            read(tmp_path)
