"""Summaries of scores."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from egosim_jax.evaluation.metrics.report import (
    cell_of,
    mean_and_spread,
    paired_difference,
    print_table,
    summarize,
)


def test_a_summary_is_mean_and_sample_deviation():
    scores = [{"psnr": 20.0, "ssim": 0.5}, {"psnr": 24.0, "ssim": 0.9}]
    summary = summarize(scores, ("psnr", "ssim"))
    assert (summary["psnr"]["mean"], summary["ssim"]["mean"]) == (22.0, pytest.approx(0.7))
    # Two values d apart deviate by d / sqrt(2).
    assert summary["psnr"]["spread"] == pytest.approx(4 / 2**0.5)
    assert summary["ssim"]["spread"] == pytest.approx(0.4 / 2**0.5)


def test_what_is_not_finite_is_ignored():
    assert mean_and_spread([1.0, np.nan, 3.0, np.inf]) == (2.0, pytest.approx(2**0.5))
    assert np.isnan(mean_and_spread([np.nan])[0])


def test_a_paired_difference_has_the_interval_of_scipys_t_test():
    rng = np.random.default_rng(1)
    for count in (2, 5, 30):
        pairs = rng.normal(1.0, 2.0, count)
        found = paired_difference([*pairs, np.nan], [0.0] * (count + 1))
        expected = ttest_1samp(pairs, 0).confidence_interval()
        assert found["mean"] == pytest.approx(pairs.mean())
        assert (found["low"], found["high"]) == pytest.approx((expected.low, expected.high))


COVERAGE = {
    "normal": (lambda rng, size: rng.normal(0, 1, size), 0.93),
    "uniform": (lambda rng, size: rng.uniform(-1, 1, size), 0.91),
    "Laplace": (lambda rng, size: rng.laplace(0, 1, size), 0.93),
    "skewed": (lambda rng, size: rng.exponential(1, size) - 1, 0.86),
}


@pytest.mark.parametrize(
    ("name", "count"), [("normal", 3), ("uniform", 5), ("Laplace", 24), ("skewed", 5)]
)
def test_an_interval_has_the_true_mean_as_often_as_it_says(name, count):
    draw, least = COVERAGE[name]
    samples = draw(np.random.default_rng(count), (4000, count))
    intervals = [paired_difference(sample, [0.0] * count) for sample in samples.tolist()]
    share = np.mean([found["low"] <= 0 <= found["high"] for found in intervals])
    assert least <= share <= 0.98
    if name == "normal":
        assert share <= 0.96


def test_a_table_has_mean_and_spreads_and_empty_cells(capsys):
    measures = {"psnr": ("PSNR dB", "{:.2f}"), "ssim": ("SSIM", "{:.3f}")}
    full = {"psnr": {"mean": 20.0, "spread": 1.0, "spread_over_seeds": 0.5}}
    print_table("method", {"full": full}, measures, title="human")
    row = next(line for line in capsys.readouterr().out.splitlines() if "full" in line)
    assert [cell.strip() for cell in row.split("│")[1:-1]] == ["full", "20.00 ± 1.00 (± 0.50)", ""]


def test_missing_values_are_counted(capsys):
    scores = [{"psnr": value} for value in (20.0, float("nan"), 22.0)]
    summary = summarize(scores, ["psnr"])
    assert (summary["psnr"]["known"], summary["psnr"]["of"]) == (2, 3)
    print_table("", {"ours": summary}, {"psnr": ("PSNR", "{:.1f}")})
    assert "21.0 ± 1.4 (2 of 3)" in capsys.readouterr().out
    difference = paired_difference([1.0, 2.0, float("nan")], [0.0, 0.0, 0.0])
    assert (difference["known"], difference["of"]) == (2, 3)


@pytest.mark.parametrize(
    ("values", "cell"),
    [
        ([28.17], "28.17"),
        ([28.17, float("nan")], "28.17 (1 of 2)"),
        ([float("nan")], "no clips (0 of 1)"),
        ([20.0, 22.0], "21.00 ± 1.41"),
    ],
)
def test_a_cell_has_a_spread_only_of_several_clips(values, cell):
    summary = summarize([{"psnr": value} for value in values], ["psnr"])["psnr"]
    assert cell_of(summary, "{:.2f}") == cell
