"""The cross-embodiment experiment, from clips to its table, in its smallest size."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from safetensors.numpy import load_file

from egosim_jax.cli.__main__ import main
from egosim_jax.data.shards import ShardReader
from egosim_jax.experiments import embodiment
from tests.unit.robots.toy import TOY, make_toy

MODELS = {"human", "full", "lora", "scratch", "converted"}
ALIKE = {"steps": 2, "batch-size": 2, "warmup": 1, "learning-rate": 0.01}


def experiment(weights: Path, run: Path, *more: str) -> list[str]:
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(run)]
    counts = ["--human-scenes", "2", "--robot-scenes", "2", "--held-out", "2", "--batch-size", "2"]
    stages = [str(x) for model in MODELS for k, v in ALIKE.items() for x in (f"--{model}.{k}", v)]
    robot = ["--robot", TOY.name]
    return ["experiment", "embodiment", *fixed, *counts, *robot, "--rank", "2", *stages, *more]


@pytest.fixture(scope="module", autouse=True)
def toy() -> Iterator[None]:
    """Put an arm without files of the Menagerie in place of every other one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{embodiment.__name__}.arm_of", lambda _: TOY)
        patch.setattr(f"{embodiment.__name__}.load_model", lambda _: make_toy())
        yield


@pytest.fixture(scope="module")
def run(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("embodiment")
    assert main(experiment(weights, folder / "run")) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def report(run: Path) -> dict:
    return json.loads((run / "report.json").read_text("utf-8"))


def test_there_is_a_row_for_each_model_and_baseline(report):
    others = {"prior copied", "first frame repeated", "ground truth through the autoencoder"}
    assert report["table"].keys() == MODELS | others
    assert all(line["psnr"]["mean"] > 0 for line in report["table"].values())


def test_robot_trainings_start_from_the_human_model(report):
    line = report["table"]
    for name in ("full", "lora", "converted"):
        assert line[name]["before"]["mean"] == pytest.approx(line["human"]["after"]["mean"])
    assert line["scratch"]["before"]["mean"] == pytest.approx(line["human"]["before"]["mean"])


def test_converted_clips_are_of_the_robot_scenes_and_compared_with_native_ones(run, report):
    source = ShardReader(run / "frames" / "converted")
    assert [record.metadata["video_id"] for record in source] == ["toy_5002_1", "toy_5003_1"]
    differences = report["differences"]
    assert differences.keys() == {"full", "human"}
    table = report["table"]
    for name, row in differences.items():
        gap = table["converted"]["psnr"]["mean"] - table[name]["psnr"]["mean"]
        assert row["psnr"]["mean"] == pytest.approx(gap)


def test_started_again_it_trains_nothing_and_reports_the_same(
    weights, run, report, capsys, monkeypatch
):
    for name in ("train.loop.train", "generation.generator.Generator.generate"):
        monkeypatch.setattr(f"egosim_jax.{name}", lambda *_, **__: pytest.fail("it was done"))
    (run / "report.json").unlink()
    assert main(experiment(weights, run)) == 0
    assert json.loads((run / "report.json").read_text("utf-8")) == report
    said = capsys.readouterr().out
    assert "human, then a LoRA: training on the robot" in said
    assert "robot alone" in said


def test_a_lost_stage_is_trained_again_to_equal_weights(weights, run):
    path = run / "lora" / "lora.safetensors"
    before = load_file(path)
    path.unlink()
    assert main(experiment(weights, run)) == 0
    again = load_file(path)
    assert again.keys() == before.keys()
    assert all((again[name] == before[name]).all() for name in before)


def test_an_invalid_stage_is_refused_before_clips_are_made(weights, tmp_path, capsys):
    assert main(experiment(weights, tmp_path / "run", "--scratch.learning-rate", "-1")) == 2
    assert "learning_rate must be positive" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
