"""`egosim models`: from a release on a hub to loadable weights."""

import json
import shutil
import tempfile

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file as load_numpy
from safetensors.torch import load_file, save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.cli.models import Fetch
from egosim_jax.convert.commands import ToTorch, Weights
from egosim_jax.io import hub
from egosim_jax.io.bounded import read_json
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError
from tests.hub import COMMIT, Hub, serve

FILES = configs.release("egosim_14b").files


@pytest.fixture(scope="module")
def published(debug_weights, tmp_path_factory):
    """A release of `debug` in the file layout of EgoSim-14B."""
    folder = tmp_path_factory.mktemp("published") / "hub"
    ToTorch(weights=debug_weights, config="debug", out=folder).run()
    for name in filter(lambda name: name.endswith(".pth"), FILES):
        written = (folder / name).with_suffix(".safetensors")
        torch.save(load_file(written), folder / name)
        written.unlink()
    (folder / "google" / "umt5-xxl").mkdir(parents=True)
    (folder / "google" / "umt5-xxl" / "tokenizer.json").write_text("{}")
    return folder


@pytest.fixture
def served(published, tmp_path, monkeypatch):
    """The release on a hub."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = shutil.copytree(published, tmp_path / "hub")
    fields = {"about": "test", "config": "debug", "revision": None, "widen": None}
    released = tmp_path / "released.json"
    entry = {**fields, "repository": "someone/debug", "files": dict(FILES)}
    released.write_text(json.dumps({"debug": entry}))
    monkeypatch.setattr(configs, "RELEASED", released)
    with serve(Hub(folder, "someone/debug"), monkeypatch) as running:
        yield running


def test_fetched_weights_are_those_of_the_release_and_are_found_by_name(
    served, debug_weights, capsys
):
    assert main(["models", "fetch", "debug"]) == ExitCode.DONE
    folder = configs.weights_of("debug", None)
    assert capsys.readouterr().out.splitlines()[-1] == str(folder)
    for file in sorted(debug_weights.glob("*.safetensors")):
        expected, found = load_numpy(file), load_numpy(folder / file.name)
        assert found.keys() == expected.keys()
        assert all(np.array_equal(found[name], expected[name]) for name in expected)
    assert read_json(folder / hub.RECORD)["revision"] == COMMIT
    assert not (folder / ".download").exists()
    served.requests.clear()
    assert main(["models", "fetch", "debug"]) == ExitCode.DONE
    assert not served.requests
    main(["models", "list"])
    assert str(folder)[:20] in capsys.readouterr().out


def other_shapes(folder):
    weights = load_file(folder / "diffusion_pytorch_model.safetensors")
    weights = {name: value[..., :-1].contiguous() for name, value in weights.items()}
    save_file(weights, folder / "diffusion_pytorch_model.safetensors")


def cut(folder):
    with (folder / "Wan2.1_VAE.pth").open("r+b") as file:
        file.truncate(file.seek(0, 2) - 4)


def in_objects(folder):
    torch.save(torch.nn.Linear(2, 2), folder / "models_t5_umt5-xxl-enc-bf16.pth")


@pytest.mark.parametrize("damage", [other_shapes, cut, in_objects])
def test_a_release_that_cannot_be_converted_is_not_downloaded(served, capsys, damage):
    damage(served.folder)
    assert main(["models", "fetch", "debug"]) == ExitCode.USAGE
    error = capsys.readouterr().err
    assert "cannot be converted, and nothing was downloaded" in error
    assert tempfile.gettempdir() not in error
    assert all(span for _, path, span in served.requests if "resolve" in path)
    assert not hub.fetched_folder("debug").exists()


def test_every_release_is_of_a_config():
    assert {release.config for release in configs.releases().values()} <= set(configs.names())
    with pytest.raises(InputError, match="Nearest: egosim_14b"):
        configs.release("egosim14b")
    for name in ("tabletop", "tabletop_student"):
        with pytest.raises(InputError, match=f"{name} is in the package, so nothing is fetched"):
            configs.release(name)


def test_a_folder_of_another_release_is_refused(served, tmp_path, monkeypatch):
    out = tmp_path / "weights"
    assert main(["models", "fetch", "debug", "--out", str(out)]) == ExitCode.DONE
    released = json.loads(configs.RELEASED.read_text())
    entry = released["debug"]
    hashes = {**entry["files"], "Wan2.1_VAE.pth": "0" * 64}
    changes = [{"repository": "someone/else"}, {"revision": "f" * 40}, {"files": hashes}]
    for change in changes:
        configs.RELEASED.write_text(json.dumps({"other": entry | change}))
        with pytest.raises(InputError, match=r"holds weights of another release.*\(--out\)"):
            Fetch(name="other", out=out).run()


def test_an_interrupted_fetch_keeps_its_complete_networks(served, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Weights, "run", interrupted_after(Weights.run))
        with pytest.raises(KeyboardInterrupt):
            Fetch(name="debug").run()
    folder, (_, sizes) = hub.fetched_folder("debug"), hub.list_files(configs.release("debug"))
    networks = sorted(folder.glob("*.safetensors"))
    before = [file.stat().st_ino for file in networks]
    there = sum(f.stat().st_size for f in networks)
    size = sum(sizes.values())
    assert hub.bytes_needed(size, folder) <= max(size - there, 0)
    assert main(["models", "fetch", "debug"]) == ExitCode.DONE
    assert [file.stat().st_ino for file in networks] == before
    assert hub.is_fetched(folder)


def interrupted_after(convert):
    """Return a conversion that is interrupted when all networks are converted."""

    def run(*args, **options):
        convert(*args, **options)
        raise KeyboardInterrupt

    return run
