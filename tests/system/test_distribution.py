"""The built wheel and sdist, installed elsewhere, are complete and run."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHECK = """
import sys
from importlib.resources import files
from pathlib import Path

import egosim_jax
from egosim_jax import configs
from egosim_jax.convert.commands import Weights
from egosim_jax.train.recipes import RECIPES

assert Path(egosim_jax.__file__).is_relative_to(sys.prefix), egosim_jax.__file__
assert (files("egosim_jax") / "py.typed").is_file()
assert configs.weights_of("tabletop", None).joinpath("vae.safetensors").is_file()
assert configs.releases()
print(egosim_jax.__version__)
"""


def run(*command: object, cwd: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheel and sdist of the files that git has."""
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("built")
    names = run("git", "ls-files", "-co", "--exclude-standard", cwd=ROOT).splitlines()
    for name in filter(lambda name: os.path.lexists(ROOT / name), names):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    build = "from setuptools import build_meta as b; b.build_sdist({0!r}); b.build_wheel({0!r})"
    run(sys.executable, "-c", build.format(str(out)), cwd=tree)
    return out


@pytest.mark.parametrize("pattern", ["*.whl", "*.tar.gz"])
def test_what_is_built_is_installed_and_runs(pattern, built, tmp_path):
    (archive,) = built.glob(pattern)
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    (site,) = home.glob("lib/python*/site-packages")
    here = next(p for p in sys.path if p.endswith("site-packages"))
    (site / "dependencies.pth").write_text(here + "\n")
    python = home / "bin" / "python"
    options = ["--no-deps", "--no-index", "--no-build-isolation", "--quiet"]
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, archive, cwd=tmp_path)
    version = run(python, "-c", CHECK, cwd=tmp_path).strip()
    for program in ("egosim", "egosim-train", "egosim-convert"):
        said = run(home / "bin" / program, "--version", cwd=tmp_path)
        assert said == f"{program} {version}\n"
    clip = ["--config", "tabletop", "--limit", "1", "--out", "clip"]
    if pattern == "*.whl":
        run(home / "bin" / "egosim", "generate", *clip, cwd=tmp_path)
        assert (tmp_path / "clip" / "contact_sheet.png").is_file()
