"""The journaled loop around a small generator, in a world with ground truth."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.io.journal import Journal, _chained
from egosim_jax.perception.oracle import OracleConfig
from egosim_jax.rendering.reference import draw_hands
from egosim_jax.runtime.phases import show_phases
from egosim_jax.simulation.rollout import Rollout
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.snapshot import fingerprint
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import InputError, Perceived, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, observation_of, to_action

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


def paint_the_hands(view, action, first_frame, seed):
    """The prior copied, the skeletons painted over it, and a little noise."""
    hands, depth = draw_hands(action.joints_m, action.cameras, kind=action.kind)
    frames = np.where((depth < view.depth_m)[..., None], hands, view.frames).astype(float)
    frames[0] = np.where(np.isfinite(depth[0])[..., None], hands[0], first_frame)
    noise = np.random.default_rng(seed).normal(0, 2, frames.shape)
    return np.clip(np.rint(frames + noise), 0, 255).astype(np.uint8)


@cache
def clips():
    return tuple(make_sequence(3, spec=SPEC, clips=2))


def oracle(of=(0, 1)):
    """The oracle of clips in that order."""
    ground_truth = {step: observation_of(clips()[number]) for step, number in enumerate(of)}
    return OracleConfig().build(ground_truth)


def simulator(**changes):
    parts = {
        "generator": paint_the_hands,
        "perception": oracle(),
        "fps": SPEC.fps,
        "fusion": Fusion(voxel_m=0.006),
    }
    return Simulator(**{**parts, **changes})


def run(out, **changes):
    actions = [to_action(clip) for clip in clips()]
    return list(Rollout(simulator(**changes), out).run(clips()[0].state, actions, seed=0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the folder and the steps of a run that nothing interrupts."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(folder)


@pytest.fixture(scope="module")
def straight(whole):
    """Return its steps."""
    return whole[1]


@pytest.fixture
def finished(whole, tmp_path):
    """Return a copy of its folder."""
    return shutil.copytree(whole[0], tmp_path / "finished")


def test_each_clip_starts_from_the_state_that_the_last_one_left(straight):
    first, second = straight
    assert (first.state.step, second.state.step) == (1, 2)
    expected = simulator().step(first.state, to_action(clips()[1]), seed=2)
    np.testing.assert_array_equal(second.view.frames, expected.view.frames)
    np.testing.assert_array_equal(second.clip.frames, expected.clip.frames)
    assert fingerprint(second.state) == fingerprint(expected.state)
    target = clips()[0].body_ids[clips()[0].target]
    moved = clips()[0].world_from_body[clips()[0].target]
    np.testing.assert_allclose(
        first.state.world_from_object[target], moved[-1] @ np.linalg.inv(moved[0]), atol=1e-12
    )


def test_a_state_that_no_camera_looks_at_is_refused(tmp_path):
    state = clips()[0].state
    behind = replace(state, points_m=state.points_m + np.float32([0, -50, 0]))
    with pytest.raises(InputError, match=r"None of the .* points of the scene is visible"):
        list(Rollout(simulator(), tmp_path).run(behind, [to_action(clips()[0])], seed=0))
    assert not any(tmp_path.rglob("*.npz"))


def test_without_perception_the_state_stays(tmp_path):
    for step in run(tmp_path, perception=None):
        assert fingerprint(step.state) == fingerprint(clips()[0].state)


def test_a_replay_gives_the_same_states(tmp_path, straight):
    assert [fingerprint(step.state) for step in run(tmp_path)] == [
        fingerprint(step.state) for step in straight
    ]


@pytest.mark.parametrize(
    "phase",
    [3, 6, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 1, 2, 4, 8))],
)
def test_a_run_killed_after_any_phase_ends_the_same(tmp_path, straight, phase):
    """A child without jax is killed at a line of the journal; the run resumes from there."""
    code = (
        "import os, signal, sys; sys.path.insert(0, sys.argv[1])\n"
        "import test_rollout as t; from pathlib import Path\n"
        "from egosim_jax.io.journal import Journal\n"
        "append = Journal._append\n"
        "def die(self, *args):\n"
        "    if len(self.done) == int(sys.argv[3]):\n"
        "        assert 'jax' not in sys.modules, 'jax was imported'\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    append(self, *args)\n"
        "Journal._append = die\n"
        "t.run(Path(sys.argv[2]))\n"
    )
    here = os.path.dirname(__file__)
    command = [sys.executable, "-c", code, here, str(tmp_path / "killed"), str(phase)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    lines = (tmp_path / "killed" / "journal.jsonl").exists()
    assert lines == (phase > 0)
    for a, b in zip(run(tmp_path / "killed"), straight, strict=True):
        np.testing.assert_array_equal(a.clip.frames, b.clip.frames)
        assert fingerprint(a.state) == fingerprint(b.state)


@dataclass
class Named:
    """A part of the loop with a fixed fingerprint that fails if it is called again."""

    part: object
    broken: bool = False

    def fingerprint(self):
        return "v1"

    def __call__(self, *args):
        assert not self.broken, "called again"
        return self.part(*args)


def test_finished_phases_are_not_run_again(tmp_path):
    for broken in (False, True):
        parts = {
            "generator": Named(paint_the_hands, broken),
            "perception": Named(oracle(), broken),
        }
        assert len(run(tmp_path, **parts)) == 2


def test_a_resumed_run_says_how_many_clips_were_made_before(finished, tmp_path, capsys):
    with show_phases():
        run(finished)
        assert f"{finished}: 2 clips made before\n" in capsys.readouterr().err
        next(run_with(tmp_path / "new"))
        assert "made before" not in capsys.readouterr().err
        run(tmp_path / "new")
        assert f"{tmp_path / 'new'}: 1 clip made before\n" in capsys.readouterr().err


def noisier(view, action, first_frame, seed):
    return 255 - paint_the_hands(view, action, first_frame, seed)


def with_action(**changes):
    first, *rest = [to_action(clip) for clip in clips()]
    return [replace(first, **changes), *rest]


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"state": clips()[1].state}, "state"),
        ({"seed": 1}, "seed"),
        ({"first_frame": np.zeros((48, 80, 3), np.uint8)}, "first_frame"),
        ({"actions": with_action(prompt="another caption")}, "action"),
        ({"actions": with_action(joints_m=to_action(clips()[0]).joints_m + 1e-6)}, "action"),
        ({"generator": noisier}, "generator"),
        ({"perception": oracle(of=(1, 0))}, "perception"),
        ({"perception": None}, "perception"),
        ({"fusion": Fusion(voxel_m=0.007)}, "fusion"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_another_run_in_the_same_folder_is_refused_with_both_values(finished, changes, field):
    with pytest.raises(InputError, match=rf"{field}: the folder has '.*', this run has '.*'"):
        list(run_with(finished, **changes))


def run_with(out, *, state=None, actions=None, seed=0, first_frame=None, **parts):
    return Rollout(simulator(**parts), str(out)).run(
        state or clips()[0].state, actions or with_action(), seed=seed, first_frame=first_frame
    )


LINE = '{"phase": "1 generate", "file": "clip_1/frames.npz", "sha256": "0", "seconds": 1}\n'


def flip(path):
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "journal.jsonl").unlink(), "is missing, although .* to start over"),
        (lambda f: (f / "journal.jsonl").write_text(LINE), "line 1 was changed.* to start over"),
        (lambda f: flip(f / "clip_1/frames.npz"), "is not the file that phase 1 generate wrote"),
    ],
    ids=["no journal", "a line without its hash", "another file"],
)
def test_a_damaged_folder_is_refused_with_the_way_out(finished, damage, message):
    damage(finished)
    with pytest.raises(InputError, match=message):
        run(finished)


@pytest.mark.parametrize("entry", [{}, {"phase": [1]}, {"phase": "run", "made_of": 3}])
def test_a_line_that_is_no_phase_is_refused_even_if_its_hash_is_right(tmp_path, entry):
    line = json.dumps({**entry, "chain": _chained("", entry)}) + "\n"
    (tmp_path / "journal.jsonl").write_text(line)
    with pytest.raises(InputError, match="line 1 was changed or is missing"):
        Journal(tmp_path)


def test_any_changed_byte_of_the_journal_is_noticed(finished):
    path = finished / "journal.jsonl"
    data = path.read_bytes()
    for place in range(0, len(data) - 1, 37):
        changed = bytearray(data)
        changed[place] ^= 4
        path.write_bytes(bytes(changed))
        with pytest.raises(InputError, match="journal"):
            Journal(finished)
    lines = data.splitlines(keepends=True)
    path.write_bytes(b"".join([lines[0], *lines[2:]]))
    with pytest.raises(InputError, match="line 2 was changed or is missing"):
        Journal(finished)


def test_a_folder_in_use_by_another_process_is_refused(tmp_path):
    code = (
        "import pathlib, sys, time; from egosim_jax.io.atomic import hold_folder\n"
        "hold_folder(pathlib.Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(InputError, match=f"in use by another process .PID {other.pid}"):
            run(tmp_path)
        other.kill()


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_an_invalid_seed_is_refused(tmp_path, seed):
    with pytest.raises(InputError, match="seed must be a whole number"):
        list(run_with(tmp_path, seed=seed))


def test_a_truncated_line_of_the_journal_is_dropped(finished, straight):
    path = finished / "journal.jsonl"
    path.write_bytes(path.read_bytes()[:-20])
    assert fingerprint(run(finished)[1].state) == fingerprint(straight[1].state)


@pytest.mark.parametrize(
    "bad", [lambda *a: np.zeros((4, 48, 80, 3), np.uint8), lambda *a: np.zeros((5, 48, 80, 3))]
)
def test_a_generator_that_returns_other_frames_is_refused(tmp_path, bad):
    with pytest.raises(InputError, match="must return the same number of frames, of the same size"):
        run(tmp_path, generator=bad)


def test_the_first_frame_may_be_given(tmp_path):
    image = np.full((48, 80, 3), 9, np.uint8)
    seen = []

    def generator(view, action, first_frame, seed):
        seen.append(first_frame)
        return view.frames

    actions = [to_action(clip) for clip in clips()]
    loop = Rollout(simulator(generator=generator), tmp_path)
    steps = list(loop.run(clips()[0].state, actions, seed=0, first_frame=image))
    np.testing.assert_array_equal(seen[0], image)
    np.testing.assert_array_equal(seen[1], steps[1].view.frames[0])


@pytest.mark.parametrize("make", [list, iter])
def test_seeds_of_all_steps_must_be_valid(tmp_path, make):
    actions = make([to_action(clip) for clip in clips()])
    steps = Rollout(simulator(), tmp_path).run(clips()[0].state, actions, seed=2**63 - 1)
    with pytest.raises(InputError, match=r"seed . number of actions must be a whole number"):
        next(steps)
    assert not (tmp_path / "clip_1").exists()


@dataclass(frozen=True)
class ChunkedPainter:
    """`paint_the_hands` in chunks of 3 and 2 frames."""

    chunk_frames = (3, 2)

    def __call__(self, *given):
        return paint_the_hands(*given)

    def begin(self, first_frame, seed):
        given = []
        take = lambda: iter([paint_the_hands(*given.pop(0), first_frame, seed)])  # noqa: E731
        return SimpleNamespace(put=lambda view, action: given.append((view, action)), take=take)


def count_chunks(clip, action, state):
    """Perception of a clip in which nothing moves; its note has the chunk."""
    depth_m = np.full(clip.frames.shape[:3], np.inf, np.float32)
    return Perceived(
        step=state.step + 1, frames=clip.frames, cameras=action.cameras, depth_m=depth_m,
        object_ids=np.zeros(depth_m.shape, np.int32), names={}, world_from_object={},
        interacted_frames={}, notes=(f"{len(clip.frames)} frames after {state.step}",),
    )  # fmt: skip


def test_a_run_that_updates_the_state_by_chunk_resumes_with_the_same_states(tmp_path):
    changes = {
        "generator": ChunkedPainter(), "perception": count_chunks, "update_every": "chunk",
    }  # fmt: skip
    made = run(tmp_path, **changes)
    assert [step.notes[0] for step in made] == ["3 frames after 0", "3 frames after 2"]
    assert [step.state.step for step in made] == [2, 4]
    again = run(tmp_path, **changes)
    assert [step.notes for step in again] == [step.notes for step in made]
    assert [fingerprint(step.state) for step in again] == [fingerprint(s.state) for s in made]
    for step, before in zip(again, made, strict=True):
        np.testing.assert_array_equal(step.view.frames, before.view.frames)
        assert step.latency.last_frame_s == before.latency.last_frame_s
    with pytest.raises(InputError, match="update_every: the folder has"):
        run(tmp_path, **{**changes, "update_every": "clip"})
