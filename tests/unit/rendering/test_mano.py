"""Hands of MANO: files in their real layout, and skinning by formulas written separately."""

import pickle
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from egosim_jax.io.untrusted.pickled_arrays import read_model
from egosim_jax.rendering.mano import ManoPoses, mano_hands, read_mano, read_poses
from egosim_jax.types import InputError
from tests.mano import PARENTS, Called, Global, Made, dump, model_pickle, random_model


@pytest.fixture(scope="module")
def arrays():
    return random_model()


@pytest.fixture
def model(arrays, tmp_path):
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(model_pickle(arrays))
    return read_mano(tmp_path / "MANO_RIGHT.pkl")


def make_poses(frames=3, seed=1):
    rng = np.random.default_rng(seed)
    return ManoPoses(
        global_orient=rng.normal(size=(frames, 2, 3)),
        hand_pose=rng.normal(scale=0.4, size=(frames, 2, 45)),
        translation_m=rng.normal(size=(frames, 2, 3)),
        betas=rng.normal(size=(2, 10)),
    )


def posed_by_hand(arrays, betas, turns):
    """Vertices of one hand by 4 x 4 matrices and the exponentials of cross products."""

    def rotation(turn):
        x, y, z = turn
        return expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))

    shaped = arrays["v_template"].copy()
    for k in range(10):
        shaped += betas[k] * arrays["shapedirs"][:, :, k]
    joints = arrays["J_regressor"] @ shaped
    bends = [(rotation(turn) - np.eye(3)).ravel() for turn in turns[1:]]
    for k, value in enumerate(np.concatenate(bends)):
        shaped = shaped + value * arrays["posedirs"][:, :, k]
    world = []
    for k, turn in enumerate(turns):
        local = np.eye(4)
        local[:3, :3] = rotation(turn)
        local[:3, 3] = joints[k] - (joints[PARENTS[k - 1]] if k else 0)
        world.append(world[PARENTS[k - 1]] @ local if k else local)
    vertices = []
    for v, point in enumerate(shaped):
        total = np.zeros(3)
        for k in range(16):
            back = np.eye(4)
            back[:3, 3] = -joints[k]
            total += arrays["weights"][v, k] * (world[k] @ back @ [*point, 1])[:3]
        vertices.append(total)
    return np.array(vertices)


def test_vertices_are_those_of_the_formulas(arrays, model):
    poses = make_poses()
    mesh = mano_hands(model, poses, left=model, add_mean=True)
    for hand in range(2):
        part = mesh.vertices_m[:, hand * 30 : (hand + 1) * 30]
        for frame in range(3):
            pose = poses.hand_pose[frame, hand] + arrays["hands_mean"]
            turns = np.concatenate([poses.global_orient[frame, hand], pose]).reshape(16, 3)
            expected = posed_by_hand(arrays, poses.betas[hand], turns)
            np.testing.assert_allclose(
                part[frame], expected + poses.translation_m[frame, hand], atol=1e-12
            )


def test_without_a_left_model_the_left_hand_is_mirrored(model):
    poses = make_poses()
    mirrored = mano_hands(model, poses).vertices_m[:, :30]
    own = mano_hands(model, poses, left=model).vertices_m[:, :30]
    place = poses.translation_m[:, 0, None]
    np.testing.assert_allclose(mirrored, (own - place) * [-1, 1, 1] + place, atol=1e-12)


def test_a_mirrored_hand_is_turned_from_the_camera_to_the_world_in_mirrored_axes(model):
    seen, mirror = make_poses(), np.diag([-1, 1, 1])
    turn = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()
    turned = mirror @ turn @ mirror @ Rotation.from_rotvec(seen.global_orient[:, 0]).as_matrix()
    orient = seen.global_orient.copy()
    orient[:, 0] = Rotation.from_matrix(turned).as_rotvec()
    placed = replace(seen, global_orient=orient, translation_m=np.ones((3, 2, 3)))
    hand, world = (mano_hands(model, poses).vertices_m[:, :30] for poses in (seen, placed))
    expected = (hand - hand[:, :1]) @ turn.T
    np.testing.assert_allclose(world - world[:, :1], expected, atol=1e-12)


def test_a_hand_may_be_missing_but_not_half(model):
    poses = make_poses()
    for name in ("global_orient", "hand_pose", "translation_m"):
        getattr(poses, name)[1, 0] = np.nan
    mesh = mano_hands(model, poses)
    assert np.isnan(mesh.vertices_m[1, :30]).all()
    assert np.isfinite(mesh.vertices_m[1, 30:]).all()
    poses.hand_pose[2, 1, 7] = np.nan
    with pytest.raises(InputError, match="Hand 1 of frame 2"):
        ManoPoses(**vars(poses))


def test_poses_are_read_from_a_file(tmp_path):
    poses = make_poses()
    np.savez(tmp_path / "poses.npz", **vars(poses))
    again = read_poses(tmp_path / "poses.npz")
    assert (again.hand_pose == poses.hand_pose).all()
    np.savez(tmp_path / "short.npz", **{**vars(poses), "betas": np.zeros((1, 10))})
    with pytest.raises(InputError, match=r"betas of the hands has shape \(1, 10\)"):
        read_poses(tmp_path / "short.npz")


def test_the_pickle_is_one_that_python_itself_reads(arrays, monkeypatch):
    class State:
        def __setstate__(self, state):
            self.__dict__.update(state)

    for name, kind in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select"),
                       ("scipy.sparse.csc", "csc_matrix")):  # fmt: skip
        module = types.ModuleType(name)
        setattr(module, kind, type(kind, (State,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    loaded = pickle.loads(model_pickle(arrays), encoding="latin1")  # noqa: S301
    select = loaded["shapedirs"]
    values = select.a.x.ravel()[select.idxs].reshape(select.preferred_shape)
    np.testing.assert_array_equal(values, arrays["shapedirs"])
    np.testing.assert_array_equal(loaded["weights"], arrays["weights"])
    assert loaded["J_regressor"]._shape == (16, 30)


def test_all_arrays_are_read(arrays, tmp_path):
    (tmp_path / "a.pkl").write_bytes(model_pickle(arrays))
    found = read_model(tmp_path / "a.pkl")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("protocol", [3, 4])
def test_plain_arrays_that_python_3_saved_are_read(arrays, tmp_path, protocol):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(arrays, protocol=protocol))
    assert read_mano(tmp_path / "a.pkl").parents == tuple(PARENTS)


def refused(tmp_path, data, message):
    (tmp_path / "bad.pkl").write_bytes(data)
    with pytest.raises(InputError, match=message) as error:
        read_mano(tmp_path / "bad.pkl")
    assert "--mano-right" in str(error.value)


def test_files_that_ask_for_code_are_refused(arrays, tmp_path):
    marker = tmp_path / "ran"
    attack = Called(Global("os", "system"), [f"touch {marker}"])
    refused(tmp_path, dump({"v_template": attack}), "disallowed global os.system")
    attack = Called(Global("__builtin__", "eval"), ["1"])
    refused(tmp_path, model_pickle(arrays, f=attack), "disallowed global __builtin__.eval")
    refused(tmp_path, dump(Made("subprocess", "Popen", {})), "disallowed global subprocess.Popen")
    assert not marker.exists()


def test_wrong_and_damaged_models_are_refused(arrays, tmp_path):
    data = model_pickle(arrays)
    refused(tmp_path, data[:-500], "cannot be read")
    refused(tmp_path, b"not a pickle", "cannot be read")
    short = {name: array for name, array in arrays.items() if name != "weights"}
    refused(tmp_path, model_pickle(short), "has no weights")
    refused(tmp_path, model_pickle(arrays, weights=np.zeros((30, 4))), r"\(30, 16\)")
    bad = np.where(arrays["f"] == 0, np.uint32(30), arrays["f"])
    refused(tmp_path, model_pickle(arrays, f=bad), "vertices up to 30")
    table = arrays["kintree_table"].copy()
    table[0, 3] = 9
    refused(tmp_path, model_pickle(arrays, kintree_table=table), "after its parent")
    infinite = Made("chumpy.ch", "Ch", {"x": np.full((30, 3), np.inf)})
    refused(tmp_path, model_pickle(arrays, v_template=infinite), "v_template")
    columns = Made("scipy.sparse.csc", "csc_matrix", {"_shape": (1 << 20, 1 << 20)})
    refused(tmp_path, model_pickle(arrays, J_regressor=columns), "cannot be read")
    looped = Made("chumpy.reordering", "Select", {"a": np.zeros(3), "idxs": np.array([9])})
    refused(tmp_path, model_pickle(arrays, shapedirs=looped), "cannot be read")
