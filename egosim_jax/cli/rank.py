"""`egosim rank`: candidate actions by the goal that their generated videos reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError, check_counts, check_seed


@dataclass(frozen=True, kw_only=True)
class Rank:
    """Generate candidate actions and rank them by an image or a text of the goal.

    By the image, the score is the negative LPIPS of the last frame (extra `metrics`); by the
    text, the similarity of the video by X-CLIP (extra `networks`). Writes the clips of each seed to
    OUT/SEED, and OUT/ranking.json; prints the ranking, best first.
    """

    config: str
    """Name of the model."""
    actions: Path
    """CSV or JSONL in EgoSim's columns: a row for each candidate, with its hands and prompt."""
    out: Path
    """Folder to write to; the same command resumes."""
    goal_image: Path | None = None
    """Image of the goal, of the shape of the model's clips."""
    goal_text: str | None = None
    """Text that describes the goal."""
    xclip: Path | None = None
    """Folder of an X-CLIP model, such as microsoft/xclip-base-patch32, for a text."""
    weights: Path | None = None
    """Folder of weights, by default those that ship with the package or were fetched."""
    lora: Path | None = None
    """LoRA of the video transformer."""
    sampling: str | None = None
    """Named sampling of the model, as in `generate`."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    seeds: int = 3
    """Repetitions of each candidate with different noise."""
    seed: int = 0
    """First seed of the noise."""
    batch_size: int | None = None
    """Clips generated together, over all devices."""

    def run(self) -> int:
        """Check the goal, generate every candidate, rank."""
        from egosim_jax import configs
        from egosim_jax.data.metadata import read_metadata
        from egosim_jax.data.windows import windows_of
        from egosim_jax.generation import rank
        from egosim_jax.generation.batch import BatchJob
        from egosim_jax.io.executables import share_with_jax
        from egosim_jax.io.images import read_image

        check_counts(
            {"--seeds": self.seeds, "--steps": self.steps, "--batch-size": self.batch_size}
        )
        check_seed(self.seed)
        check_seed(self.seed + self.seeds)
        if (self.goal_image is None) == (self.goal_text is None):
            raise InputError(
                "Candidates are ranked by one goal: either an image or a text of it, not "
                f"{'both' if self.goal_text else 'neither'}. (--goal-image, --goal-text)"
            )
        if self.goal_image is not None and self.xclip is not None:
            raise InputError(
                "An image is compared by LPIPS, not by X-CLIP: omit the network, or give a text "
                "of the goal. (--xclip, --goal-image)"
            )
        config = configs.get(self.config)
        if self.goal_image is not None:
            goal, measure = str(self.goal_image), "-LPIPS of the last frame to the goal"
            video = config.video
            score = rank.by_image(read_image(self.goal_image), (video.height, video.width))
        else:
            goal, measure = str(self.goal_text), "similarity of the video to the goal"
            score = rank.by_text(goal, self.xclip)
        windows = windows_of(read_metadata(self.actions), (0,))
        if len(windows) < 2:
            raise InputError(
                f"{self.actions} has {len(windows)} candidate: a ranking needs at least 2. "
                "(--actions)"
            )
        share_with_jax()
        config = config if self.sampling is None else configs.sampled(config, self.sampling)
        weights = configs.weights_of(self.config, self.weights)
        config = replace(config.at(weights), steps=self.steps or config.steps)
        jobs = [
            BatchJob(
                model=config,
                out=self.out / str(seed),
                weights=weights,
                lora=self.lora,
                seed=seed,
                batch_size=self.batch_size,
                skip_existing=True,
            )
            for seed in range(self.seed, self.seed + self.seeds)
        ]
        rank.report(rank.rank(jobs, windows, score), self.out, goal=goal, measure=measure)
        return ExitCode.DONE
