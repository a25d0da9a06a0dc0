"""Episodes: files, bytes and refusals."""

import io
import json
import zipfile
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.io.digest import fingerprint
from egosim_jax.simulation.actions import ORDERS, check_order
from egosim_jax.simulation.episode import Episode, _read_ground_truth
from egosim_jax.state.snapshot import save
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_episode

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


@pytest.fixture(scope="module", params=["human", "robot"])
def episode(request):
    return to_episode(list(make_sequence(3, spec=SPEC, clips=2, kind=request.param)), fps=8)


@pytest.fixture(scope="module")
def hands():
    return to_episode(list(make_sequence(3, spec=SPEC, clips=2)), fps=8)


def test_a_folder_and_bytes_give_the_same_episode(episode, tmp_path):
    episode.save(tmp_path / "episode")
    episode.save(tmp_path / "episode.zip")
    for path in ("episode", "episode.zip"):
        assert fingerprint(Episode.load(tmp_path / path)) == fingerprint(episode)
    assert Episode.load(tmp_path / "episode").to_bytes() == episode.to_bytes()


def test_everything_optional_may_be_missing(hands, tmp_path):
    bare = replace(hands, first_frame=None, ground_truth=())
    bare.save(tmp_path / "bare")
    loaded = Episode.load(tmp_path / "bare")
    assert fingerprint(loaded) == fingerprint(bare)
    assert loaded.observations() is None


def test_ground_truth_may_be_frames_alone(hands, tmp_path):
    frames = tuple(
        replace(known, depth_m=None, object_ids=None, motions=None, target_id=None)
        for known in hands.ground_truth
    )
    video = replace(hands, ground_truth=frames)
    video.save(tmp_path / "video")
    assert fingerprint(Episode.load(tmp_path / "video")) == fingerprint(video)
    assert video.observations() is None
    assert sorted(hands.observations()) == [0, 1]


def with_joints(episode, change):
    action = episode.actions[1]
    return replace(episode, actions=(episode.actions[0], replace(action, joints_m=change(action))))


def with_cameras(episode, **changes):
    first, second = episode.actions
    changed = replace(second, cameras=replace(second.cameras, **changes))
    return replace(episode, actions=(first, changed))


@pytest.mark.parametrize("order", ORDERS)
def test_another_order_of_the_joints_is_named(hands, order):
    undo = np.argsort(ORDERS[order])
    with pytest.raises(InputError, match=r"clip 2: .* seem to be in the order") as caught:
        with_joints(hands, lambda action: action.joints_m[:, :, undo])
    assert f"{order}: reorder them by joints_m[:, :, {ORDERS[order].tolist()}]" in str(caught.value)


TIPS_FIRST = np.r_[4:21:4, 0, [f + k for f in range(1, 21, 4) for k in range(3)]]
LITTLE_FIRST = np.r_[0, np.arange(1, 21).reshape(5, 4)[::-1].ravel()]


@pytest.mark.parametrize("noise_m", [0.0, 0.004])
@pytest.mark.parametrize(
    "order", [TIPS_FIRST, LITTLE_FIRST, np.random.default_rng(0).permutation(21)]
)
def test_an_order_that_nobody_listed_is_refused(hands, order, noise_m):
    def change(action):
        jitter = noise_m * np.random.default_rng(1).normal(size=action.joints_m.shape)
        return (action.joints_m + jitter)[:, :, order]

    with pytest.raises(InputError, match="wrist, then thumb"):
        with_joints(hands, change)


@pytest.mark.parametrize("order", [TIPS_FIRST, LITTLE_FIRST, np.arange(21)[::-1]])
def test_an_environment_refuses_bones_in_another_order_only(hands, order):
    """It takes random hands and straight paths between poses, whose bones change, too."""
    action = hands.actions[1]
    moving = action.joints_m[:, :1]
    check_order(replace(action, joints_m=moving), any_hand=True)
    with pytest.raises(InputError, match="wrist, then thumb"):
        check_order(replace(action, joints_m=moving[:, :, order]), any_hand=True)
    share = np.linspace(0, 1, len(moving))[:, None, None, None]
    for end in (moving[-1][:, order], np.random.default_rng(0).uniform(-0.2, 0.2, (1, 21, 3))):
        check_order(replace(action, joints_m=moving[:1] * (1 - share) + end * share), any_hand=True)


@pytest.mark.parametrize("seed", range(4))
def test_hands_of_any_closure_are_in_order(seed):
    to_episode(list(make_sequence(seed, spec=SPEC, clips=3)), fps=8)


def test_a_fist_is_not_taken_for_a_hand_in_another_order(hands):
    finger = np.array([[0, -0.09, 0], [0, -0.08, 0.022], [0, -0.06, 0.022], [0, -0.042, 0.014]])
    across = np.arange(-2, 3)[:, None, None] * [0.003, 0, 0]
    fist = np.concatenate([np.zeros((1, 3)), (finger + across).reshape(20, 3)])
    with_joints(hands, lambda a: a.joints_m[:, :, :1] + fist)


def test_a_gripper_with_the_wrist_last_is_refused():
    robot = to_episode(list(make_sequence(3, spec=SPEC, clips=2, kind="robot")), fps=8)
    with pytest.raises(InputError, match="wrist, thumb tip, index tip"):
        with_joints(robot, lambda action: np.roll(action.joints_m, -1, axis=2))


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda e: with_joints(e, lambda a: 1000 * a.joints_m), "must be in meters"),
        (lambda e: with_joints(e, lambda a: a.joints_m + 9), "comes near the view"),
        (lambda e: with_joints(e, lambda a: a.joints_m[:, :, :20]), "21, 3"),
        (lambda e: with_joints(e, lambda a: a.joints_m[:4]), "path of 5 cameras"),
        (lambda e: with_cameras(e, height=64), "clip 2: .*all clips must agree"),
        (lambda e: replace(e, actions=()), "at least one action"),
        (lambda e: replace(e, fps=0), "fps must be at least 1"),
        (lambda e: replace(e, ground_truth=e.ground_truth[:1]), "one per action, or none"),
        (lambda e: replace(e, first_frame=e.first_frame[1:]), "as large as the cameras"),
        (
            lambda e: replace(e, state=replace(e.state, points_m=e.state.points_m + 90)),
            "sees none of the",
        ),
        (lambda e: in_millimeters(e), "Convert the state to meters"),
        (lambda e: jumping(e), "world_from_camera must be in meters"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_rule(hands, break_it, message):
    with pytest.raises(InputError, match=message):
        break_it(hands)


def in_millimeters(episode):
    """The state alone in millimeters, around the first camera."""
    eye = episode.actions[0].cameras.world_from_camera[0, :3, 3].astype(np.float32)
    points = eye + 1000 * (episode.state.points_m - eye)
    return replace(episode, state=replace(episode.state, points_m=points))


def jumping(episode):
    first, second = episode.actions
    poses = second.cameras.world_from_camera.copy()
    poses[2, 0, 3] += 50
    changed = replace(second, cameras=replace(second.cameras, world_from_camera=poses))
    return replace(episode, actions=(first, changed))


def test_any_changed_byte_of_a_file_is_noticed(hands, tmp_path):
    hands.save(tmp_path / "episode")
    for file in sorted((tmp_path / "episode").rglob("*.*")):
        data = file.read_bytes()
        for place in (0, len(data) // 2, len(data) - 3):
            changed = bytearray(data)
            changed[place] ^= 1
            file.write_bytes(bytes(changed))
            if file.name == "episode.json":
                with suppress(InputError):
                    Episode.load(tmp_path / "episode")
            else:
                with pytest.raises(InputError, match=r"episode: .*damaged or was changed"):
                    Episode.load(tmp_path / "episode")
        file.write_bytes(data)


def test_a_missing_file_is_named(hands, tmp_path):
    hands.save(tmp_path / "episode")
    (tmp_path / "episode" / "clip_2" / "action.npz").unlink()
    with pytest.raises(InputError, match=r"clip_2/action\.npz"):
        Episode.load(tmp_path / "episode")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("format", "zip", "does not describe an episode"),
        ("version", 2, "this program reads version 1"),
        ("prompts", "one", "prompts is 'one', not list"),
        ("prompts", [1, 2], "every prompt must be text"),
        ("prompts", ["one"], "unknown: 'clip_2/action.npz'"),
        ("target_ids", ["a", "b"], "object ids or null"),
        ("kind", "robot", "robot hands of a path"),
        ("height", True, "height is True, not int"),
    ],
)
def test_a_description_that_is_not_valid_is_refused(hands, tmp_path, field, value, message):
    hands.save(tmp_path / "episode")
    path = tmp_path / "episode" / "episode.json"
    written = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({**written, field: value}))
    with pytest.raises(InputError, match=message):
        Episode.load(tmp_path / "episode")


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("nothing.txt", r"is no episode: it has no episode\.json\.$"),
        ("annotation.json", "an annotated clip: egosim episode from-annotation .*taken"),
        ("metadata.csv", r"a folder of clips.*from-annotation .*taken/CLIP"),
        ("meta/info.json", "a LeRobot dataset: egosim episode from-lerobot .*taken"),
        ("session.json", "a session: `save`"),
        ("contact_sheet.png", "a simulation"),
    ],
)
def test_a_folder_that_is_no_episode_is_named(tmp_path, file, message):
    path = tmp_path / "taken" / file
    path.parent.mkdir(parents=True)
    path.touch()
    with pytest.raises(InputError, match=message):
        Episode.load(tmp_path / "taken")


def test_a_video_is_annotated_first(tmp_path):
    path = tmp_path / "lift.MP4"
    path.write_bytes(b"video")
    with pytest.raises(InputError, match="is a video: annotate it"):
        Episode.load(path)


def archive(entries, compression=zipfile.ZIP_STORED):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", compression) as file:
        for name, content in entries:
            file.writestr(name, content)
    return data.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"not a zip", "not a readable zip archive"),
        (archive([("../../evil", b"x")]), "not part of an episode"),
        (archive([("/etc/passwd", b"x")]), "not part of an episode"),
        (archive([("episode.json", b"0" * 99999)], zipfile.ZIP_DEFLATED), "compressed"),
        (archive([("episode.json", b"{}")]), "does not describe an episode"),
        (archive([]), r"episode\.json"),
    ],
)
def test_bytes_that_are_no_episode_are_refused(data, message):
    with pytest.raises(InputError, match=message):
        Episode.from_bytes(data)


def test_a_folder_of_other_files_is_never_replaced(hands, tmp_path, monkeypatch):
    (tmp_path / "cap").mkdir()
    (tmp_path / "cap" / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    for path in ("cap", ".", "cap/notes.txt"):
        with pytest.raises(InputError, match="Choose another path"):
            hands.save(path)
        with pytest.raises(InputError, match="Choose another path"):
            save(path, hands.state)
    assert (tmp_path / "cap" / "notes.txt").read_text() == "mine"
    (tmp_path / "empty").mkdir()
    for _ in range(2):
        hands.save("empty")
    (tmp_path / "empty" / "clip_1" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds clip_1/notes\.txt"):
        hands.save("empty")


def test_arrays_of_any_layout_are_read_back(hands, tmp_path):
    points = np.asfortranarray(hands.state.points_m)
    known = tuple(
        replace(k, target_id=np.int64(5), depth_m=np.asfortranarray(k.depth_m))
        for k in hands.ground_truth
    )
    given = replace(hands, state=replace(hands.state, points_m=points), ground_truth=known)
    given = with_joints(given, lambda action: np.asfortranarray(action.joints_m))
    given.save(tmp_path / "episode")
    assert fingerprint(Episode.load(tmp_path / "episode").state) == fingerprint(hands.state)
    assert Episode.from_bytes(given.to_bytes()).to_bytes() == given.to_bytes()


def test_bytes_over_the_limit_of_reading_are_not_written(hands, monkeypatch):
    monkeypatch.setattr("egosim_jax.simulation.episode.MAX_BYTES", 1000)
    with pytest.raises(InputError, match=r"at most 1,000\. Save it to a folder"):
        hands.to_bytes()


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda e: replace(e, fps=16.0), "whole number"),
        (lambda e: replace(e, first_frame=e.first_frame / 255), "must be uint8"),
        (lambda e: with_cameras(e, world_from_camera=turned(e)), "clip 2: its first camera"),
    ],
)
def test_values_that_could_not_be_read_back_are_refused(hands, break_it, message):
    with pytest.raises(InputError, match=message):
        break_it(replace(hands, actions=tuple(without_hands(a) for a in hands.actions)))


def without_hands(action):
    return replace(action, joints_m=np.full_like(action.joints_m, np.nan))


def turned(episode):
    """Cameras of the second clip that look the other way."""
    return episode.actions[1].cameras.world_from_camera @ np.diag([-1.0, 1, -1, 1])


@pytest.mark.parametrize("ids", [[7, 7], [[7, 8]], [7]])
def test_motions_without_one_id_each_are_refused(hands, tmp_path, ids):
    frames = hands.ground_truth[0].frames
    motions = np.tile(np.eye(4), (2, len(frames), 1, 1))
    path = tmp_path / "ground_truth.npz"
    np.savez(path, frames=frames, motion_ids=np.array(ids, np.int32), motions=motions)
    with pytest.raises(InputError, match="each of the motions once"):
        _read_ground_truth(path, None)


def test_a_gripper_may_have_unequal_fingers_in_some_frames():
    robot = to_episode(list(make_sequence(3, spec=SPEC, clips=2, kind="robot")), fps=8)
    joints = robot.actions[1].joints_m.copy()
    joints[0, :, 1] = joints[0, :, 0] + 0.5 * (joints[0, :, 1] - joints[0, :, 0])
    assert with_joints(robot, lambda _: joints).actions[1].joints_m is joints
