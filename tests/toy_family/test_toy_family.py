"""A second family, without one line for it in egosim_jax, train or convert.

Its config is registered by putting its folder on the path of `egosim_jax.configs`; all else is what
users call.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.convert.__main__ import main as egosim_convert
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.generation.generator import Generator
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models import (
    Denoiser,
    DenoiserConfig,
    TextEncoder,
    TextEncoderConfig,
    VideoCodec,
    VideoCodecConfig,
)
from egosim_jax.train.config import TrainConfig
from egosim_jax.train.encode import check_encoders
from egosim_jax.train.fine_tuning import FineTuning
from egosim_jax.types import InputError, Triplet

HERE = Path(__file__).parent
SPACE_MASK = {
    "parts": (("noisy", 6), ("mask", 4), ("prior", 6), ("hands", 6)),
    "mask_packing": "space",
}
WIDER = {"in_channels": 22}
PROMPTS = ("take cup", "open drawer", "close drawer")


@pytest.fixture(scope="module", autouse=True)
def toy():
    """Register the toy model by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(configs, "__path__", [*configs.__path__, str(HERE / "configs")])
        yield configs.get("toy")


@pytest.fixture(scope="module")
def weights(toy: ModelConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    Networks.random(toy, seed=0).save(folder)
    return folder


def triplet(number: int, config: ModelConfig) -> Triplet:
    rng, video = np.random.default_rng(number), config.video
    size = (video.frames, video.height, video.width)
    clips = [rng.integers(0, 256, (*size, 3), np.uint8) for _ in range(3)]
    return Triplet(
        video_id=f"clip_{number}",
        prompt=PROMPTS[number],
        prior=clips[0],
        hands=clips[1],
        target=clips[2],
        mask=rng.integers(0, 2, size, np.uint8) * np.uint8(255),
        first_frame=clips[0][0],
    )


@pytest.fixture(scope="module")
def latents(toy: ModelConfig, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Latents of three clips, encoded by the command."""
    folder = tmp_path_factory.mktemp("latents")
    source = ShardWriter(folder / "clips", kind="frames", spec=toy.video, grid=toy.grid)
    with source as writer:
        for number in range(len(PROMPTS)):
            made = triplet(number, toy)
            names = ("prior", "hands", "target", "mask", "first_frame")
            arrays = {name: getattr(made, name) for name in names}
            writer.add(arrays, {"video_id": made.video_id, "prompt": made.prompt})
    command = f"data encode --config toy --weights {weights} --shards {folder / 'clips'}"
    assert egosim([*command.split(), "--out", str(folder / "out")]) == 0
    return folder / "out"


def tune(weights: Path, latents: Path, out: Path, **options: object) -> None:
    training = TrainConfig(steps=4, batch_size=2, log_every=1, save_every=2)
    recipe = FineTuning(
        config="toy", weights=weights, latents=latents, out=out, training=training, **options
    )
    assert recipe.train() == 0


def arrays_of(file: Path) -> dict[str, np.ndarray]:
    return {name: tensor.array() for name, tensor in read_safetensors(file).items()}


def test_its_networks_and_configs_satisfy_the_protocols(toy: ModelConfig):
    networks = Networks.abstract(toy)
    assert isinstance(networks.dit, Denoiser)
    assert isinstance(networks.vae, VideoCodec)
    assert isinstance(networks.text, TextEncoder)
    assert isinstance(toy.dit, DenoiserConfig)
    assert isinstance(toy.vae, VideoCodecConfig)
    assert isinstance(toy.text, TextEncoderConfig)
    assert toy.latent_shape == (4, 3, 5)


def test_it_generates_clips_that_depend_on_every_condition(toy: ModelConfig, weights: Path):
    generator = Generator.load("toy", weights)
    triplets = [triplet(number, toy) for number in range(2)]
    clips = generator.generate(triplets, [1, 2])
    assert [clip.frames.shape for clip in clips] == [(7, 12, 20, 3)] * 2
    latents = generator.latents(triplets, [1, 2])
    for name in ("prior", "mask", "hands", "text"):
        without = generator.latents(triplets, [1, 2], without=name)
        assert not np.array_equal(without, latents), name


def test_it_caches_what_its_layout_reads(toy: ModelConfig, latents: Path):
    record = ShardReader(latents)[1].arrays
    assert record["mask"].shape == (4, 3, 5, 1)
    expected = triplet(1, toy).mask[::2, ::4, ::4] // 255
    np.testing.assert_array_equal(record["mask"][1:, ..., 0], expected[1:])
    assert {record[name].shape for name in ("target", "prior", "hands")} == {(4, 3, 5, 6)}
    assert record["text"].shape == (16, 8)


def test_latents_of_another_packing_of_the_mask_are_refused(toy: ModelConfig, latents: Path):
    check_encoders(latents, toy, None)
    other = replace(toy, layout=replace(toy.layout, mask_packing="observed"))
    with pytest.raises(InputError, match=r"mask: the shards have .*single.* has .*observed"):
        check_encoders(latents, other, None)


def test_its_rematerialization_is_refused_unless_it_has_it(toy: ModelConfig):
    with pytest.raises(InputError, match="no --remat"):
        FineTuning(config="toy", remat="full", training=TrainConfig(steps=1)).model()
    with pytest.raises(InputError, match=r"rematerialization most: it must be one of offload"):
        FineTuning(config="debug", remat="most", training=TrainConfig(steps=1)).model()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dit": {"patch": (1, 1, 5)}}, "must be square"),
        ({"vae": {"spatial_stride": 3}, "layout": SPACE_MASK, "dit": WIDER}, "must be even, not 3"),
    ],
)
def test_a_mask_or_patch_without_cells_is_refused(toy: ModelConfig, changes, message):
    changed = {name: replace(getattr(toy, name), **fields) for name, fields in changes.items()}
    with pytest.raises(InputError, match=message):
        replace(toy, **changed)


def test_loading_changes_no_setting_of_jax(weights: Path):
    before = dict(jax.config.values)
    Generator.load("toy", weights)
    assert dict(jax.config.values) == before


def test_it_trains_and_resumes_bit_for_bit(weights: Path, latents: Path, tmp_path: Path):
    tune(weights, latents, tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped")
    shutil.rmtree(tmp_path / "stopped" / "checkpoints" / "4")
    shutil.rmtree(tmp_path / "stopped" / "weights")
    tune(weights, latents, tmp_path / "stopped")
    have, want, start = (
        arrays_of(folder / "dit.safetensors")
        for folder in (tmp_path / "stopped/weights", tmp_path / "whole/weights", weights)
    )
    for name in want:
        np.testing.assert_array_equal(have[name], want[name], err_msg=name)
    assert not np.array_equal(want["input.kernel"], start["input.kernel"])


def test_its_lora_adapts_what_its_config_says(
    toy: ModelConfig, weights: Path, latents: Path, tmp_path: Path
):
    tune(weights, latents, tmp_path / "run", rank=2)
    file = tmp_path / "run" / "lora.safetensors"
    layers = {f"blocks.{i}.up.{part}" for i in range(2) for part in ("down", "up")}
    assert arrays_of(file).keys() == {*layers, "input.kernel.diff", "input.bias.diff"}
    adapted = Generator.load("toy", weights, lora=file)
    trained = (
        arrays_of(file)["input.kernel.diff"]
        + arrays_of(weights / "dit.safetensors")["input.kernel"]
    )
    np.testing.assert_allclose(adapted.networks.dit.input.kernel[...], trained, rtol=1e-6)
    plain = Generator.load("toy", weights)
    made = [generator.latents([triplet(0, toy)], [0]) for generator in (adapted, plain)]
    assert not np.array_equal(*made)


def test_it_converts_there_and_back(weights: Path, tmp_path: Path):
    there, back = tmp_path / "there", tmp_path / "back"
    command = f"to-torch {weights} --config toy --layout toy --out {there}"
    assert egosim_convert(command.split()) == 0
    names = {path.stem for path in there.glob("*.safetensors")}
    assert names == {"denoiser", "codec", "text"}
    assert egosim_convert(f"weights {there} --config toy --out {back}".split()) == 0
    for network in ("dit", "vae", "text"):
        have, want = (arrays_of(f / f"{network}.safetensors") for f in (back, weights))
        assert have.keys() == want.keys()
        for name in want:
            np.testing.assert_array_equal(have[name], want[name], err_msg=name)


def test_a_base_model_without_hands_is_widened(toy: ModelConfig, weights: Path, tmp_path: Path):
    there, back = tmp_path / "there", tmp_path / "back"
    command = f"to-torch {weights} --config toy --layout toy --only dit --out {there}"
    assert egosim_convert(command.split()) == 0
    from safetensors.numpy import load_file

    base = load_file(there / "denoiser.safetensors")
    base["proj_in.weight"] = np.ascontiguousarray(base["proj_in.weight"][:, :13])
    save_file(base, there / "denoiser.safetensors")
    command = f"weights {there} --config toy --only dit --widen polarity --out {back}"
    assert egosim_convert(command.split()) == 0
    have, want = (arrays_of(f / "dit.safetensors")["input.kernel"] for f in (back, weights))
    np.testing.assert_array_equal(have[:13], want[:13])
    assert not have[13:].any()
