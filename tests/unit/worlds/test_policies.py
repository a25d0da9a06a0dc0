"""Policies with large faults fail in the true world."""

from itertools import count

import numpy as np
import pytest

from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import World, make_scripts
from egosim_jax.worlds.tabletop.policies import POLICIES, Policy, goal_error_m, succeeded

SPEC = VideoSpec(frames=17, height=8, width=8)


@pytest.fixture(scope="module")
def script():
    scripts = (next(make_scripts(seed, spec=SPEC)) for seed in count(400))
    return next(script for script in scripts if script.intent.verb == "carry")


def error_of(policy, script, seed=0):
    joints = policy.plan(script, np.random.default_rng(seed))
    assert joints.shape == script.action.joints_m[:, :1].shape
    _, after = World(scene=script.scene).move(script.action, joints_m=joints)
    return goal_error_m(after.scene.body(script.intent.name), script.intent.goal_m)


def test_a_policy_without_faults_does_what_the_script_does(script):
    joints = Policy(name="exact").plan(script, np.random.default_rng(0))
    np.testing.assert_allclose(joints[:, 0], script.action.joints_m[:, 0], atol=1e-12)
    assert succeeded(error_of(Policy(name="exact"), script))


@pytest.mark.parametrize(
    "policy",
    [
        Policy(name="never closes", grasps=False),
        Policy(name="opens", release=0.5),
        Policy(name="wrong", wrong=1.0),
        Policy(name="far", goal_m=1.0),
    ],
)
def test_a_policy_with_a_large_fault_fails(script, policy):
    assert not succeeded(error_of(policy, script))


def test_a_goal_that_is_off_moves_the_body_there(script):
    errors = np.random.default_rng(0).normal(size=(2, 2))[1]
    found = error_of(Policy(name="off", goal_m=0.02), script)
    assert found[0] == pytest.approx(0.02 * np.linalg.norm(errors), abs=0.01)


def test_policies_have_different_names():
    assert len({policy.name for policy in POLICIES}) == len(POLICIES) >= 8
