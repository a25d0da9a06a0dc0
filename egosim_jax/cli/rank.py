"""`egosim rank`: rank candidate actions by how well their generated videos reach a goal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError, check_counts, check_seed


@dataclass(frozen=True, kw_only=True)
class Rank:
    """Generate a video of each candidate action, and rank the actions by a goal image or text.

    With a goal image, the score is the negative LPIPS of the last frame (extra `metrics`). With a
    goal text, it is the X-CLIP similarity of the video (extra `networks`). Writes the clips of each
    seed to OUT/SEED, and OUT/ranking.json. Prints the ranking, best first.
    """

    config: str
    """Name of the model."""
    actions: Path
    """CSV or JSONL with EgoSim's columns: one row per candidate, with its hands and prompt."""
    out: Path
    """Folder to write to; the same command resumes an interrupted run."""
    goal_image: Path | None = None
    """Image of the goal, at the size of the model's clips."""
    goal_text: str | None = None
    """Text that describes the goal."""
    xclip: Path | None = None
    """Folder of an X-CLIP model for --goal-text, such as microsoft/xclip-base-patch32."""
    weights: Path | None = None
    """Folder of weights; by default the shipped or fetched ones."""
    lora: Path | None = None
    """LoRA of the video transformer."""
    sampling: str | None = None
    """Named sampling settings of the model, as in `generate`."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    seeds: int = 3
    """Number of clips per candidate, with different noise."""
    seed: int = 0
    """First seed of the noise."""
    batch_size: int | None = None
    """Clips generated together on all devices."""

    def run(self) -> int:
        """Check the goal, generate all candidates, rank them."""
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
                "An image is compared by LPIPS, not by X-CLIP: omit --xclip, or give a goal "
                "text. (--xclip, --goal-image)"
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
