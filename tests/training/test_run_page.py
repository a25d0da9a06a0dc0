"""The page of a training run, from folders like those that `train` writes."""

import base64
import io
import json
import re

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.view import View
from egosim_jax.train.loop import train
from egosim_jax.train.run_page import MAX_POINTS, Stage, draw_curves, stages_of, write_page
from egosim_jax.types import InputError
from tests.training.finished import write_stage
from tests.training.line import Line, training, write_points


def inline(page: str, kind: str) -> list[bytes]:
    """Return the decoded contents of the inline data of a kind."""
    return [base64.b64decode(text) for text in re.findall(f'"data:{kind};base64,([^"]*)"', page)]


def test_the_page_has_curves_samples_times_and_settings(tmp_path):
    run = write_stage(tmp_path / "run", samples=(20, 40))
    page = write_page(run).read_text()
    assert "<h2>run: step 40 of 40</h2>" in page
    (curves,) = inline(page, r"image/svg\+xml")
    assert curves.count(b'id="axes_') == 3  # loss and validation loss, lr, grad_norm
    assert [Image.open(io.BytesIO(sheet)).size for sheet in inline(page, "image/jpeg")] == [
        (192, 80)
    ] * 2
    assert inline(page, "video/mp4") == [(run / "samples" / "step_000040.mp4").read_bytes()]
    assert page.index("step 40</p>") < page.index("step 20</p>")
    for name, value in {
        "loss": "0.05",
        "validation_loss": "0.0731707",
        "step_time_s": "0.25",
        "compiling": "6.0 (75%)",
        "training.batch_size": "8",
        "packages.jax": "0.10.2",
    }.items():
        assert f"<tr><th>{name}</th><td>{value}</td></tr>" in page


def test_a_training_draws_its_page(tmp_path, capsys):
    points = write_points(tmp_path / "points")
    train(Line(), training(steps=3), data=points, validation=points, out=tmp_path / "run")
    page = (tmp_path / "run" / "index.html").read_text()
    assert "step 3 of 3" in page
    (curves,) = inline(page, r"image/svg\+xml")
    assert curves.count(b'id="axes_') >= 3
    said = capsys.readouterr().err
    assert f"curves, sample clips and settings: {tmp_path / 'run' / 'index.html'}" in said


def test_the_page_loads_nothing_and_escapes_every_text(tmp_path):
    page = write_page(write_stage(tmp_path / "<b>run", samples=(40,))).read_text()
    assert "default-src 'none'" in page
    assert not re.search(r"https?:|<script|<b>|<link|@import", page)
    assert "&lt;script&gt;alert(1)" in page
    assert "&lt;b&gt;run" in page


@pytest.mark.usefixtures("undrawn")
def test_stages_are_in_the_order_of_the_recipe(tmp_path):
    for name in ("denoiser", "vae"):
        write_stage(tmp_path / name)
    assert [stage.folder.name for stage in stages_of(tmp_path)] == ["denoiser", "vae"]
    (tmp_path / "config.json").write_text('{"config": "debug", "vae": {}, "denoiser": {}}')
    page = write_page(tmp_path).read_text()
    assert re.findall("<h2>([a-z]+):", page) == ["vae", "denoiser"]
    assert "Settings of the whole run" in page


def test_the_scores_of_an_evaluation_are_no_training(tmp_path):
    write_stage(tmp_path / "denoiser")
    for folder in (tmp_path / "generated", tmp_path):
        folder.mkdir(exist_ok=True)
        (folder / "metrics.jsonl").write_text('{"video_id": "a", "generated": {"psnr": 20.0}}\n')
        (folder / "config.json").write_text('{"model": {}, "seed": 0}')
    assert [stage.folder.name for stage in stages_of(tmp_path)] == ["denoiser"]


def test_a_long_log_is_drawn_by_means(tmp_path):
    steps = np.arange(1, 10 * MAX_POINTS + 1)
    short = draw_curves({"loss": {"training": (steps[:MAX_POINTS], np.sin(steps[:MAX_POINTS]))}})
    long = draw_curves({"loss": {"training": (steps, np.sin(steps))}})
    assert len(long) < 1.5 * len(short)


def test_values_that_are_not_finite_are_drawn_around(tmp_path):
    steps = np.arange(5)
    curves = {"loss": {"training": (steps, np.array([1, np.nan, np.inf, 200, 1.0]))}}
    assert b'id="axes_1"' in draw_curves(curves)


def test_a_log_that_is_being_written_is_read(tmp_path):
    run = write_stage(tmp_path / "run")
    with (run / "metrics.jsonl").open("a") as log:
        log.write('{"step": 50, "lr": 0.5, "grad_norm": 2.0}\n{"step": 60, "los')
    metrics = Stage(run).metrics
    assert metrics["lr"][1][-1] == 0.5
    assert metrics["grad_norm"][0][-1] == 50
    assert metrics["loss"][0][-1] == 40


def test_view_writes_the_page_of_a_training(tmp_path, capsys):
    run = write_stage(tmp_path / "run")
    assert View(path=run, out=tmp_path / "mine.html").run() == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "mine.html")
    assert not (run / "index.html").exists()
    View(path=run).run()
    assert (run / "index.html").read_text() == (tmp_path / "mine.html").read_text()


def test_a_folder_without_a_training_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"needs metrics\.jsonl"):
        write_page(tmp_path)


HOSTILE_METRICS = {
    "mathtext": {"$\\foo$": 1.0, "$": 2.0, "$a$b$": 3.0, "\\": 1.0},
    "controls": {"\x1b[31mred": 1.0, "a\nb": 1.0, "\u202e": 1.0, "": 1.0, "_hidden": 1.0},
    "numbers": {"big": 10**400, "inf": "1e999", "nan": float("nan"), "bool": True, "text": "x"},
    "wide": {"wide": 1e308, "small": 5e-324, "negative": -1e308},
    "nested": {"list": [1, [2]], "map": {"a": {}}, "null": None},
    "many": {f"name_{number}": float(number) for number in range(300)},
    "long": {"x" * 100_000: 1.0},
    "html": {"</table><script>alert(1)</script>": 1.0, '"><img src=x>': 2.0},
    "levels": {"validation_loss_" + "9" * 500: 1.0, "validation_loss_.": 2.0},
}


SLOW = {"many": pytest.mark.slow}


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=SLOW.get(kind, ())) for kind in HOSTILE_METRICS]
)
def test_a_page_is_made_of_any_metrics(tmp_path, kind):
    run = write_stage(tmp_path / "run")
    lines = [json.dumps({"step": step} | HOSTILE_METRICS[kind]) for step in (1, 2)]
    lines[1] = lines[1].replace("2", "3", 1).replace('"1e999"', "1e999")
    text = "\n".join([*lines, '{"step": 1e999, "loss": 1}', '{"step": -1}', "[]", "7"]) + "\n"
    with (run / "metrics.jsonl").open("a") as file:
        file.write(text + json.dumps({"step": 10**30, "loss": 1.0}) + "\n")
    page = write_page(run).read_text()
    assert "<script" not in page
    assert len(page) < 10_000_000


def deep(depth: int) -> str:
    return '{"a":' * depth + "1" + "}" * depth


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.json", '{"training": 3}'),
        ("config.json", '{"training": {"steps": "many"}}'),
        ("config.json", '{"training": {"steps": 1e999, "rate": ' + "9" * 4000 + "}}"),
        ("config.json", '{"training": ' + deep(200) + "}"),
        ("config.json", '{"training": ' + "[" * 300 + "]" * 300 + "}"),
        ("times.json", '{"a": "x", "b": null, "c": [1]}'),
        ("times.json", '{"a": 0}'),
        ("times.json", '{"a": 1e999, "b": NaN, "c": -1e308}'),
        ("environment.json", "[1, 2]"),
    ],
)
def test_a_page_is_made_of_any_settings(tmp_path, name, text):
    run = write_stage(tmp_path / "run")
    (run / name).write_text(text)
    assert "<h2>run: step 40" in write_page(run).read_text()


def bomb() -> bytes:
    data = io.BytesIO()
    Image.new("1", (30_000, 30_000)).save(data, "PNG")
    return data.getvalue()


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "data",
    [b"", b"no image", bomb(), b"\x89PNG\r\n\x1a\n" + bytes(99)],
    ids=["empty", "text", "bomb", "damaged"],
)
def test_an_image_that_cannot_be_shown_is_named(tmp_path, data):
    run = write_stage(tmp_path / "run", samples=(20, 40))
    (run / "samples" / "step_000020.png").write_bytes(data)
    page = write_page(run).read_text()
    assert "not shown: step_000020.png" in page
    assert len(inline(page, "image/jpeg")) == 1


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "name",
    ["samples/step_000040.mp4", "samples/step_000040.png", "times.json", "environment.json"],
)
def test_a_link_out_of_the_run_is_not_embedded(tmp_path, name):
    run = write_stage(tmp_path / "run", samples=(20, 40))
    path, secret = run / name, tmp_path / "secret"
    path.rename(secret)
    path.symlink_to(secret)
    shown = write_page(run).read_text()
    path.unlink()
    assert shown == write_page(run).read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_stage_or_folder_of_samples_that_is_a_link_is_not_shown(tmp_path):
    other = write_stage(tmp_path / "other", samples=(40,))
    run = write_stage(tmp_path / "run" / "own")
    (tmp_path / "run" / "linked").symlink_to(other)
    (run / "samples").symlink_to(other / "samples")
    assert [stage.folder.name for stage in stages_of(tmp_path / "run")] == ["own"]
    assert "data:video" not in write_page(tmp_path / "run").read_text()


@pytest.mark.usefixtures("undrawn")
def test_names_that_are_no_text_are_shown_escaped(tmp_path):
    run = write_stage(tmp_path / "run\udcff", samples=(40,))
    image = run / "samples" / "step_000040.png"
    image.rename(image.with_name("step_\udcfe.png"))
    assert "run\\udcff" in write_page(run).read_text()
