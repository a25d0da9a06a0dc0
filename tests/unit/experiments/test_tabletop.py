"""The worst clips of the experiment `tabletop`, and the goals that they miss."""

import numpy as np

from egosim_jax.experiments.tabletop import missed_goals, worst_clips

GOOD = {"object_lost": 0.0, "object_error": 1.0, "hand_iou": 0.8, "region_psnr": 22.0}


def test_a_goal_is_missed_on_either_side():
    assert missed_goals(GOOD, GOOD) == []
    bad = {"object_lost": 25.0, "object_error": 1.0, "hand_iou": 0.6, "region_psnr": 22.0}
    assert missed_goals(bad, GOOD) == ["object lost in 25 % (0 %)", "hand IoU 0.60 (0.80)"]


def test_an_unmeasured_goal_is_not_missed():
    assert missed_goals(GOOD | {"object_error": np.nan}, GOOD) == []


def test_the_worst_miss_most_goals_and_then_have_the_worst_region():
    dark, blurred = GOOD | {"region_psnr": 15.0}, GOOD | {"region_psnr": 20.0}
    lost = blurred | {"object_lost": 50.0}
    found = worst_clips([GOOD, blurred, dark, lost], [GOOD] * 4, count=3)
    assert list(found) == [3, 2, 1]
    assert found[2] == ["region 15.0 dB (22.0)"]
