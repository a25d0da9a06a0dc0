"""Summaries of scores."""

import pytest

from egosim_jax.metrics.report import Score, summarize, summarize_splits


def test_a_summary_is_mean_and_sample_deviation():
    summary = summarize([Score(psnr=20.0, ssim=0.5), Score(psnr=24.0, ssim=0.9)])
    assert summary.clips == 2
    assert (summary.psnr, summary.ssim) == (22.0, pytest.approx(0.7))
    # Two values d apart deviate by d / sqrt(2).
    assert summary.psnr_spread == pytest.approx(4 / 2**0.5)
    assert summary.ssim_spread == pytest.approx(0.4 / 2**0.5)


def test_a_single_clip_has_no_spread():
    assert summarize([Score(psnr=20.0, ssim=0.5)]).psnr_spread == 0.0


def test_clips_are_gathered_by_split_and_method():
    low, high = Score(psnr=10.0, ssim=0.1), Score(psnr=30.0, ssim=0.9)
    splits = summarize_splits(
        [
            ("train", {"prior": low, "vae": high}),
            ("test", {"prior": high}),
            ("train", {"prior": low}),
        ]
    )
    assert splits["train"]["prior"].clips == 2
    assert splits["train"]["vae"].psnr == 30.0
    assert splits["test"]["prior"].psnr == 30.0
