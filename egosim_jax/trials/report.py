"""Report of an evaluation: tables of success and agreement, report.json, and the page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.evaluation import pages
from egosim_jax.evaluation.metrics import rates
from egosim_jax.evaluation.metrics.report import cell_of, print_table, summarize
from egosim_jax.io.run import write_json
from egosim_jax.io.video import read_video
from egosim_jax.runtime.progress import track
from egosim_jax.trials import agreement
from egosim_jax.trials.evaluation import Results, by_policy
from egosim_jax.trials.trial import VIDEO

Result = Mapping[str, Any]
Table = dict[str, dict[str, dict[str, float]]]
ALL = "all tasks"
SUCCESS = "{:.0f}"
ENDS = {
    "refused": ("actions refused", "{:.0f}"),
    "held": ("frames held", "{:.0f}"),
}
TRUE = {"true_success": ("true success, same actions %", "{:.0f}")}
DEFINITIONS = {
    **rates.DEFINITIONS,
    "trial": "a policy with a task, from a start; it ends with success, after the last clip, when "
    "the policy ends it, or when an action is out of bounds, which is no success",
    "refused": "trials that ended with an action out of bounds",
    "held": "frames for which the last row was held, because a policy gave fewer rows than a clip "
    "has; mean over trials",
    **agreement.DEFINITIONS,
}


def summary_of(results: Results, reference: str) -> dict[str, Any]:
    """Return the contents of report.json; differences are from a reference policy."""
    policies = by_policy(results.finished)
    tasks = [ALL, *dict.fromkeys(result["group"] for result in results.finished)]
    tasks = tasks if len(tasks) > 2 else tasks[:1]
    success: Table = {}
    gaps: Table = {}
    for policy, trials in policies.items():
        success[policy] = {task: _rate(_of(trials, task)) for task in tasks}
        if policy != reference and reference in policies:
            gaps[policy] = {
                task: _gap(_of(trials, task), _of(policies[reference], task)) for task in tasks
            }
    return {
        "definitions": DEFINITIONS,
        "tasks": tasks,
        "reference": reference,
        "success": success,
        "differences": gaps,
        "validity": {policy: _validity(trials) for policy, trials in policies.items()},
        "failed": results.failed,
        "trials": results.finished,
    }


def _of(trials: Sequence[Result], task: str) -> list[Result]:
    return [trial for trial in trials if task in (ALL, trial["group"])]


def _rate(trials: Sequence[Result]) -> dict[str, float]:
    if not trials:
        return {}
    successes = sum(trial["success"] for trial in trials)
    return {**rates.rate(successes, len(trials)), "known": successes, "of": len(trials)}


def _gap(trials: Sequence[Result], others: Sequence[Result]) -> dict[str, float]:
    """Return the paired difference over the tasks and starts that both policies have."""
    ours, theirs = (
        {(t["task"], t["start"]): t["success"] for t in side} for side in (trials, others)
    )
    pairs = [key for key in ours if key in theirs]
    return rates.difference([ours[key] for key in pairs], [theirs[key] for key in pairs])


def _validity(trials: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return the figures of agreement, and how trials ended."""
    known = [trial["true_success"] for trial in trials if "true_success" in trial]
    refused = sum(trial["ended"].startswith("refused") for trial in trials)
    figures = {name: _mean(trials, name) for name in agreement.MEASURES}
    return {
        **{name: value for name, value in figures.items() if value},
        "refused": {"mean": float(refused)},
        "held": {"mean": float(np.mean([trial["held_frames"] for trial in trials]))},
        **({"true_success": rates.rate(sum(known), len(known))} if known else {}),
    }


def _mean(trials: Sequence[Result], name: str) -> dict[str, float]:
    """Return mean and spread of a figure over the trials that have it."""
    values = [{name: trial[name]} for trial in trials if name in trial]
    return summarize(values, [name]).get(name, {})


def columns_of(summary: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return title and format of the columns of success."""
    return {task: (f"{task}, success %", SUCCESS) for task in summary["tasks"]}


def validity_of(summary: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return title and format of the columns of validity that have a figure."""
    columns = {**TRUE, **agreement.MEASURES, **ENDS}
    has = {name for row in summary["validity"].values() for name in row}
    return {name: column for name, column in columns.items() if name in has}


def with_p(gaps: Mapping[str, Mapping[str, float]]) -> str:
    """Return the p-value of a policy's difference over all tasks, in words."""
    gap = gaps[ALL]
    if "p" not in gap:
        return "no common trials"
    return f"better in {gap['better']}, worse in {gap['worse']}, p = {gap['p']:.2g}"


def show(summary: Mapping[str, Any]) -> None:
    """Print the tables."""
    columns = columns_of(summary)
    count = len(summary["trials"])
    print_table("policy", summary["success"], columns, title=f"success in {count} trials")
    if summary["differences"]:
        title = f"difference from {summary['reference']}, in the same trials"
        rows = {f"{p} ({with_p(g)})": g for p, g in summary["differences"].items()}
        print_table("policy", rows, columns, title=title)
    title = "validity: where the world may be wrong"
    print_table("policy", summary["validity"], validity_of(summary), title=title)


def write(
    out: Path, summary: Mapping[str, Any], *, world: str, fps: float, clips: int
) -> Iterator[Path]:
    """Write report.json and, if jinja2 is installed, the page; yield their paths."""
    write_json(out / "report.json", {"world": world, **summary})
    yield out / "report.json"
    if clips and pages.can_be_written():
        _write_page(out, summary, world=world, fps=fps, clips=clips)
        yield out / pages.PAGE


def _write_page(
    out: Path, summary: Mapping[str, Any], *, world: str, fps: float, clips: int
) -> None:
    columns, validity = columns_of(summary), validity_of(summary)
    success = _table(summary["success"], columns, "success, with 95 % intervals")
    success["reference"] = f"{summary['reference']} in the same trials"
    success["differences"] = [
        (f"{policy} ({with_p(gaps)})", _cells(gaps, columns))
        for policy, gaps in summary["differences"].items()
    ]
    caption = "validity: mean ± spread over trials"
    pages.render(
        out / pages.PAGE,
        title=f"Policies in the {world} world",
        tables=[success, _table(summary["validity"], validity, caption)],
        notes=[f"{name}: {text}" for name, text in summary["definitions"].items()],
        skipped=[f"{trial}: {reason}" for trial, reason in summary["failed"].items()],
        clips=list(_shown(out, summary, fps, clips)),
    )


def _table(
    rows: Mapping[str, Any], columns: Mapping[str, tuple[str, str]], caption: str
) -> dict[str, Any]:
    return {
        "corner": "policy",
        "caption": caption,
        "heads": [heading for heading, _ in columns.values()],
        "rows": [(policy, False, _cells(row, columns)) for policy, row in rows.items()],
        "reference": "",
        "differences": [],
    }


def _cells(row: Mapping[str, Any], columns: Mapping[str, tuple[str, str]]) -> list[str]:
    return [cell_of(row.get(name, {}), form) for name, (_, form) in columns.items()]


def _shown(
    out: Path, summary: Mapping[str, Any], fps: float, count: int
) -> Iterator[pages.ShownClip]:
    """Yield the first tasks and starts, each with a video that has a column for each policy."""
    together: dict[tuple[str, str], list[Result]] = {}
    for trial in summary["trials"]:
        together.setdefault((trial["task"], trial["start"]), []).append(trial)
    chosen = list(together.items())[:count]
    for (task, start), trials in track(chosen, "drawing", total=len(chosen)):
        videos = [read_video(out / "trials" / t["id"] / VIDEO).frames for t in trials]
        frames = pages.columns_of(videos, *videos[0].shape[1:3])
        yield pages.ShownClip(
            title=f"{start}: {task}",
            prompt=trials[0]["instruction"],
            names=[f"{t['policy']}: {'success' if t['success'] else 'no success'}" for t in trials],
            video=pages.as_uri(frames, fps / pages.EVERY),
            scores=[["policy", "clips", "ended", "last reward"], *map(_scores, trials)],
        )


def _scores(trial: Result) -> list[str]:
    reward = f"{trial['rewards'][-1]:.3f}" if trial["rewards"] else ""
    return [trial["policy"], str(trial["clips"]), trial["ended"], reward]
