"""Scenes of your own are built as described, or refused with rule, value and fix."""

import json

import numpy as np
import pytest

from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop import Object, make_scene, read_scene, write_scene

OBJECTS = [
    Object(shape="box", color="red", place_m=(0.1, 0.3), turn_degrees=20, pattern="checks"),
    Object(shape="cup", color="blue", on="red box"),
    Object(shape="lidded box", color="green", place_m=(-0.1, 0.3), opening=1),
    Object(shape="ball", color="white", on="green chest", width_m=0.066),
]


def test_bodies_are_where_they_were_put():
    scene = make_scene(OBJECTS)
    assert [body.name for body in scene.bodies] == [
        "red box", "blue cup", "green chest", "white ball",
    ]  # fmt: skip
    places = [body.world_from_body[:3, 3] for body in scene.bodies]
    np.testing.assert_allclose(
        places, [[0.1, 0.3, 0], [0.1, 0.3, 0.075], [-0.1, 0.3, 0], [-0.1, 0.3, 0.007]]
    )
    assert scene.openings == {"green chest": 1.0}


def test_a_scene_is_read_as_it_was_written(tmp_path):
    write_scene(tmp_path / "scene.json", OBJECTS, room=3)
    read, made = read_scene(tmp_path / "scene.json"), make_scene(OBJECTS, room=3)
    for one, other in zip(read.bodies, made.bodies, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.world_from_body, other.world_from_body)
        np.testing.assert_array_equal(one.parts[0].vertices_m, other.parts[0].vertices_m)
    assert read.room[0].part.paint == made.room[0].part.paint


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": "sphere"}, "shape 'sphere': it must be one of box"),
        ({"color": "pink"}, "color 'pink': it must be one of red"),
        ({"pattern": 3}, "pattern 3: it must be one of"),
        ({"place_m": None}, "neither place_m and on"),
        ({"on": "blue cup"}, "both place_m and on"),
        ({"place_m": (0.9, 0.3)}, "x from -0.65 to 0.65"),
        ({"place_m": (0.1,)}, "place_m of the red box"),
        ({"place_m": (float("nan"), 0.2)}, "place_m of the red box"),
        ({"width_m": 0.5}, "width_m of the red box is 0.5: it must be a number from 0.02"),
        ({"width_m": True}, "width_m of the red box is True"),
        ({"opening": 0.5}, "cannot be opened"),
        ({"shape": "drawer", "turn_degrees": 5}, "has a fixed size"),
    ],
)
def test_an_invalid_object_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        Object(**{"shape": "box", "color": "red", "place_m": (0.1, 0.3), **change})


def test_bodies_with_equal_names_or_overlap_are_refused():
    red = Object(shape="box", color="red", place_m=(0.1, 0.3))
    with pytest.raises(InputError, match="two objects named red box"):
        make_scene([red, red])
    with pytest.raises(InputError, match=r"overlap by .* mm"):
        make_scene([red, Object(shape="box", color="blue", place_m=(0.15, 0.3))])
    with pytest.raises(InputError, match="which is not before it"):
        make_scene([Object(shape="box", color="red", on="blue box")])
    ball = Object(shape="ball", color="blue", place_m=(0.1, 0.3))
    with pytest.raises(InputError, match="does not stand on the blue ball"):
        make_scene([ball, Object(shape="box", color="red", on="blue ball")])
    with pytest.raises(InputError, match="0 objects"):
        make_scene([])


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ([], "does not describe a scene"),
        ({"format": "egosim_jax.scene", "version": 2}, "version 2; this program reads version 1"),
        ({"format": "egosim_jax.scene", "version": 1}, "objects: None"),
        ({"format": "egosim_jax.scene", "version": 1, "objects": [], "extra": 1}, "'extra'"),
        ({"format": "egosim_jax.scene", "version": 1, "objects": [3]}, "must have shape and color"),
        (
            {"format": "egosim_jax.scene", "version": 1, "objects": [{"shape": "box", "size": 1}]},
            "'size'",
        ),
        (
            {"format": "egosim_jax.scene", "version": 1, "objects": [{"shape": [], "color": {}}]},
            "shape",
        ),
    ],
)
def test_an_invalid_scene_file_is_refused_by_name(tmp_path, written, message):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(written))
    with pytest.raises(InputError, match=message) as error:
        read_scene(path)
    assert "scene.json" in str(error.value)
