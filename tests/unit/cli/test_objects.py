"""Objects of `egosim episode`: made with a scene, checked and shown."""

import json

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.episode import CheckEpisode, MakeEpisode, ShowEpisode
from egosim_jax.cli.objects import names_of, objects_of
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError
from tests.boxes import GREEN, RED, cameras, cast, push

VIEW = cameras(17)


@pytest.fixture(scope="module")
def scene():
    return cast([RED, GREEN], VIEW)


@pytest.fixture(scope="module")
def files(scene, tmp_path_factory):
    """The documented files of an own scene: a clip as JSON, an image, its depth, and a mask."""
    folder = tmp_path_factory.mktemp("scene")
    image, depth, ids = scene
    action, _ = push(VIEW)
    arrays = {
        "world_from_camera": action.cameras.world_from_camera,
        "intrinsics_px": action.cameras.intrinsics_px,
        "joints_m": action.joints_m,
    }
    lists = {name: array.tolist() for name, array in arrays.items()}
    (folder / "clip_1.json").write_text(json.dumps(lists))
    Image.fromarray(image).save(folder / "scene.png")
    Image.fromarray(ids.astype(np.uint16)).save(folder / "mask.png")
    np.savez(folder / "depth.npz", depth_m=depth)
    return folder


def make(files, out, **options):
    MakeEpisode(
        out=out,
        actions=(files / "clip_1.json",),
        image=files / "scene.png",
        depth=files / "depth.npz",
        **options,
    ).run()
    return Episode.load(out).state


def test_objects_are_found_named_and_printed(files, tmp_path, capsys):
    state = make(files, tmp_path / "out", names=("1=can",))
    assert set(state.object_ids.tolist()) == {0, 1, 2}
    assert state.names == {1: "can", 2: "object 2"}
    printed = capsys.readouterr().out
    assert "2 objects: can, " in printed
    assert " cm" in printed


def test_make_and_check_warn_of_a_scene_without_objects(files, tmp_path, capsys):
    state = make(files, tmp_path / "out", objects="none")
    assert not state.object_ids.any()
    assert "only what a hand closes on can move" in capsys.readouterr().out
    assert CheckEpisode(path=tmp_path / "out").run() == 0
    printed = capsys.readouterr().err
    assert printed.startswith("warning: ")
    assert "--objects auto" in printed


def test_the_first_row_of_the_sheet_has_the_objects(files, tmp_path):
    make(files, tmp_path / "out", objects=str(files / "mask.png"))
    ShowEpisode(path=tmp_path / "out", out=tmp_path / "sheet.png", renderer="numpy").run()
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.height == 2 * (96 + 16)


def save(image, path, mode):
    if mode == "P":
        palette = Image.fromarray(image.astype(np.uint8)).convert("P")
        palette.putdata(image.astype(np.uint8).ravel().tolist())
        palette.putpalette([0, 0, 0, 255, 0, 0, 0, 255, 0])
        palette.save(path)
    else:
        Image.fromarray(image.astype(mode)).save(path)


@pytest.mark.parametrize("mode", ["uint16", "P"])
def test_a_mask_has_the_ids_as_they_are_written(scene, tmp_path, mode):
    image, depth, ids = scene
    save(ids, tmp_path / "mask.png", mode)
    found, _ = objects_of(str(tmp_path / "mask.png"), image, depth, VIEW.intrinsics_px)
    np.testing.assert_array_equal(found, ids)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("masks", "must be auto, none, a .png of object ids"),
        ("missing.png", "missing.png"),
        ("small.png", "80x48 and the image 160x96 pixels"),
        ("colors.png", "must be a PNG with one channel"),
        ("sam9=weights", "--objects"),
    ],
)
def test_objects_that_cannot_be_read_are_refused(scene, tmp_path, monkeypatch, chosen, message):
    image, depth, _ = scene
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.zeros((48, 80), np.uint8)).save("small.png")
    Image.fromarray(image).save("colors.png")
    phrases = ("cup",) if "=" in chosen else ()
    with pytest.raises(InputError, match=message):
        objects_of(chosen, image, depth, VIEW.intrinsics_px, phrases=phrases)


def test_names_are_of_objects():
    ids = np.array([[0, 3], [3, 0]])
    assert names_of(ids, {}, ["3=red box"]) == {3: "red box"}
    for wrong in ("4=cup", "cup", "3=", "x=cup"):
        with pytest.raises(InputError, match="ID=NAME with the id of an object, one of 3"):
            names_of(ids, {}, [wrong])


def test_objects_need_an_image(files, tmp_path):
    with pytest.raises(InputError, match="--objects needs --image and --depth"):
        MakeEpisode(
            out=tmp_path / "out",
            actions=(files / "clip_1.json",),
            state=tmp_path,
            objects="none",
        ).run()
    with pytest.raises(InputError, match="--objects needs --actions"):
        MakeEpisode(out=tmp_path / "out", objects="auto").run()
