"""Objects of `egosim episode`: made with a scene, checked and shown."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.episode import CheckEpisode, MakeEpisode, ShowEpisode
from egosim_jax.cli.objects import describe_objects, names_of, objects_of
from egosim_jax.rendering.objects import color_of, draw_objects
from egosim_jax.rendering.reference import render
from egosim_jax.simulation.episode import Episode
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import InputError, View
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


def test_a_view_is_colored_by_object(scene):
    image, depth, ids = scene
    state = state_from_depth(image, depth, VIEW.intrinsics_px, np.eye(4), object_ids=ids)
    one = replace(VIEW, world_from_camera=VIEW.world_from_camera[:1])
    view = render(state, one, point_px=1)
    drawn = draw_objects(view, {1: "red box"})
    other = view.object_ids == 0
    assert (drawn[other] == view.frames[other]).mean() > 0.97  # names reach over the objects
    tint = np.median(drawn[view.object_ids == 1].astype(float), axis=0)
    plain = np.median(view.frames[view.object_ids == 1].astype(float), axis=0)
    np.testing.assert_allclose(tint, 0.4 * plain + 0.6 * np.array(color_of(1)), atol=25)


def white(frame):
    """Bounds of the letters: rows, columns."""
    rows, columns = np.nonzero((frame > 100).all(axis=-1))
    return rows.min(), rows.max(), columns.min(), columns.max()


@pytest.mark.parametrize("column", [0, 79, 158], ids=["left", "middle", "right"])
def test_names_of_near_objects_do_not_overlap_and_stay_in_the_image(column):
    ids = np.zeros((1, 96, 160), np.int32)
    ids[0, 40:42, column : column + 2], ids[0, 42:44, column : column + 2] = 1, 2
    frames = np.zeros((1, 96, 160, 3), np.uint8)
    view = View(
        frames=frames, mask=ids.astype(np.uint8), depth_m=ids.astype(np.float32), object_ids=ids
    )
    names = {1: "first long name", 2: "second long name"}
    both = white(draw_objects(view, names)[0])
    alone = [
        white(draw_objects(replace(view, object_ids=np.where(ids == n, n, 0)), names)[0])
        for n in names
    ]
    heights = [bottom - top + 1 for top, bottom, *_ in alone]
    assert both[1] - both[0] + 1 >= sum(heights)
    assert both[2] > 0
    assert both[3] < 159
    widths = [right - left for *_, left, right in alone]
    assert both[3] - both[2] >= max(widths)


def save(image, path, mode):
    if mode == "P":
        palette = Image.fromarray(image.astype(np.uint8)).convert("P")
        palette.putdata(image.astype(np.uint8).ravel().tolist())
        palette.putpalette([0, 0, 0, 255, 0, 0, 0, 255, 0])
        palette.save(path)
    else:
        Image.fromarray(image.astype(mode)).save(path)


@pytest.mark.parametrize("mode", ["uint8", "uint16", "P"])
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


def test_a_state_without_objects_cannot_move(scene):
    image, depth, _ = scene
    state = state_from_depth(image, depth, VIEW.intrinsics_px, np.eye(4))
    assert describe_objects(state).startswith("no objects: no point has an object id")
