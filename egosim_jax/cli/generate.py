"""`egosim generate`: generate clips from a metadata file of conditions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from egosim_jax.data.clip_files import Prompts
from egosim_jax.runtime import interrupts
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError, MeshConfig, check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.data.windows import Window


@dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate a clip for each row of a metadata file, or for scenes of the tabletop world.

    Writes {id}.mp4, {id}_cmp.mp4 (prior | hands | generated | ground truth), contact_sheet.png (the
    same videos of the first clips), results.jsonl, config.json and environment.json. Prints the
    path of each clip.
    """

    help_groups: ClassVar[HelpGroups] = {
        "clips": ("robot", "limit", "where", "video_id", "start", "prompts", "lenient", "decoding"),
        "sampling": (
            "steps",
            "sampling",
            "strength",
            "solver",
            "guidance",
            "guidance_interval",
            "cache",
            "activations_8bit",
            "progressive",
            "lora",
            "lora_scale",
            "baseline",
        ),
        "run": ("batch_size", "skip_existing", "reconstruct"),
    }
    config: str
    """Name of the model (`egosim models list`)."""
    metadata: Path | None = None
    """CSV or JSONL with EgoSim's columns, or a DWM list; by default scenes of the tabletop world.

    The columns: ego_prior_video, hand_keypoint_video, first_frame, prompt, video_id, and video if
    the ground truth is known. Tabletop scenes are written to OUT/scenes."""
    robot: bool = False
    """Use a robot gripper instead of human hands in the tabletop world."""
    out: Path | None = None
    """Folder to write to; by default runs/CONFIG_SEED."""
    weights: Path | None = None
    """Folder of weights; by default the shipped or fetched ones.

    The model `debug` has random weights."""
    lora: Path | None = None
    """LoRA of the video transformer, with PEFT, diffusers, kohya or ComfyUI names.

    A file, or DWM's folder of a LoRA and fully trained weights. LightX2V's four-step LoRAs of Wan
    2.1 set steps, guidance and solver."""
    lora_scale: float | None = None
    """Strength of the LoRA."""
    video_id: tuple[str, ...] = ()
    """Ids of the clips to generate; by default all."""
    where: str | None = None
    """Select rows by the value of a column, for instance split=test."""
    limit: int | None = None
    """Maximum number of clips; without --metadata, number of scenes, with consecutive seeds."""
    start: Annotated[tuple[int, ...], tyro.conf.arg(metavar="FRAME [FRAME ...]")] = (0,)
    """First frame of the generated window; each of several makes a clip {id}_{frame}."""
    prompts: Prompts = "prompts_rewrite"
    """Captions to read from a DWM list.

    prompts_rewrite: rewritten captions, as in the released models, or the original caption where
    there is no rewritten one; prompts: original captions, as in the paper's evaluation."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    sampling: str | None = None
    """Named sampling settings of the model, such as `released` or `paper` of DWM.

    They may set steps, solver, guidance and prompt; --steps and --solver override them."""
    strength: float | None = None
    """Start from the prior with this fraction of the noise, such as 0.75 (SDEdit).

    Only this fraction of the steps runs. The prior is then not a condition."""
    solver: str | None = None
    """Solver, instead of the model's: a name, or MODULE:NAME of your own, with its options.

    euler; unipc; wan: UniPC with Wan's noise levels and integer timesteps; ddim; dpmpp_2m:
    DPM-Solver++ (2M); dpmpp_2m_sde: its SDE form, which adds noise at each step; renoise: new noise
    at each step, for distilled networks."""
    guidance: float | None = None
    """Scale of the guidance on the text, instead of the model's; 1: none, half the time."""
    guidance_interval: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = (
        None
    )
    """Guide only at timesteps from LOW to HIGH, of 0 (data) to 1000 (noise)."""
    cache: float | None = None
    """Reuse a step's prediction while its estimated relative error is below this, such as 0.05.

    Without it every step is exact (docs/performance.md, "Fewer forward passes")."""
    activations_8bit: bool = False
    """Compute the products of 8-bit weights with 8-bit activations (`egosim convert quantize`)."""
    progressive: float | None = None
    """Run this share of the steps, the first ones, on half the rows and columns of the latents.

    For instance 0.6. Without it every step is exact."""
    seed: int = 0
    """Seed of the noise and, without --metadata, of the first scene."""
    batch_size: int | None = None
    """Clips generated together on all devices; by default, or a multiple of, mesh.data x mesh.fsdp.
    """
    mesh: MeshConfig = field(default_factory=lambda: MeshConfig(data=-1, fsdp=1))
    """Layout of the devices; by default each generates separate clips.

    Less time for one clip: --mesh.data 1 --mesh.context -1. Weights too large for one device:
    --mesh.data 1 --mesh.fsdp -1."""
    lenient: bool = False
    """Repair input as EgoSim's loader does, instead of rejecting it.

    Repeats or cuts frames, resizes videos, and treats all pixels as observed if a mask is missing.
    """
    decoding: Literal["accurate", "official"] = "accurate"
    """Color decoding of videos; official: as in EgoSim's loader, one gray level darker."""
    baseline: Literal["no_hands", "hand_mask", "sdedit"] | None = None
    """Baseline to generate: without hands, with a mask of the hands, or by SDEdit.

    SDEdit starts from the noised prior, at --strength or 0.75."""
    skip_existing: bool = False
    """Skip clips whose video exists; stop if it was made from other inputs."""
    reconstruct: bool = False
    """Also write {id}_vae.mp4, the ground truth through the autoencoder: an upper bound."""

    def run(self) -> int:
        """Check all options, compile and generate."""
        interrupts.resume_by("--skip-existing")
        with phase(f"loads JAX and {self.config}"):
            from egosim_jax.generation.batch import BatchJob
            from egosim_jax.io.executables import share_with_jax
            from egosim_jax.worlds.tabletop.dataset import conditions_of, write_scenes

            self._check()
        share_with_jax()
        job = BatchJob(
            model=self._model(),
            out=self.out or Path("runs") / f"{self.config}_{self.seed}",
            weights=self._weights,
            lora=self.lora,
            lora_scale=1.0 if self.lora_scale is None else self.lora_scale,
            seed=self.seed,
            batch_size=self.batch_size,
            mesh=self.mesh,
            policy="lenient" if self.lenient else "strict",
            decoding=self.decoding,
            skip_existing=self.skip_existing,
            reconstruct=self.reconstruct,
            baseline=self.baseline,
        )
        windows = None if self.metadata is None else self._windows(self.metadata)
        job.open()
        if windows is None:
            seeds = range(self.seed, self.seed + (self.limit or 1))
            kind = "robot" if self.robot else "human"
            prior, hands = conditions_of(job.model)
            with phase(f"makes {len(seeds)} scenes of the tabletop world"):
                scenes = write_scenes(
                    job.out / "scenes",
                    seeds,
                    spec=job.model.video,
                    kind=kind,
                    prior=prior,
                    hands=hands,
                )
            windows = self._windows(scenes)
        outcome = job.generate(windows)
        if outcome.rejected == len(windows):
            return ExitCode.USAGE
        return ExitCode.PARTIAL if outcome.rejected or outcome.failed else ExitCode.DONE

    def _check(self) -> None:
        from egosim_jax.models import eight_bit

        check_counts(
            {"--steps": self.steps, "--batch-size": self.batch_size, "--limit": self.limit}
        )
        check_seed(self.seed)
        check_seed(self.seed + (self.limit or 0))
        if min(self.start) < 0:
            raise InputError(f"--start must be at least 0, not {min(self.start)}.")
        if self.robot and self.metadata is not None:
            raise InputError(
                "--robot is for the tabletop world: the clips of --metadata have their own hands. "
                "Omit one of them. (--robot, --metadata)"
            )
        if self.prompts != "prompts_rewrite" and self.metadata is None:
            raise InputError(
                f"--prompts {self.prompts} is for a DWM list: scenes of the tabletop world have "
                "one caption. Give a list, or omit this option. (--prompts, --metadata)"
            )
        if self.lora is None and self.lora_scale is not None:
            raise InputError(
                "--lora-scale is the strength of a LoRA: give its file as well. (--lora)"
            )
        if self.lora is not None and self._weights is None:
            raise InputError(f"--lora needs weights: {self.config} has random ones. (--weights)")
        if self.activations_8bit and self._weights is None:
            raise InputError(
                f"--activations-8bit needs weights in 8 bits: {self.config} has random ones. "
                "(--weights)"
            )
        if self.lora is not None and self._weights is not None:
            eight_bit.check_lora(self._weights)

    def _windows(self, metadata: Path) -> Sequence[Window]:
        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.data.windows import windows_of

        clips = select(
            read_metadata(metadata, prompts=self.prompts),
            where=self.where,
            video_ids=self.video_id,
            limit=self.limit,
        )
        return windows_of(clips, self.start)

    def _model(self) -> ModelConfig:
        """Return the model config with the options applied."""
        from egosim_jax import configs
        from egosim_jax.diffusion import SOLVERS, Guidance, Progressive, RectifiedFlow, StepCache
        from egosim_jax.generation.batch import STRENGTH
        from egosim_jax.generation.distilled import distilled

        config = configs.get(self.config)
        config = config if self.sampling is None else configs.sampled(config, self.sampling)
        config = config if self._weights is None else config.at(self._weights)
        if (
            self.lora is not None
            and self.sampling is None
            and (few_steps := distilled(config, self.lora)) is not None
        ):
            config = few_steps
            print(
                f"{printable(self.lora.name)} is distilled: {config.steps} steps without guidance, "
                "unless --steps, --guidance or --solver say otherwise",
                file=sys.stderr,
            )
        strength = self.strength
        if self.baseline == "sdedit" and strength is None:
            strength = STRENGTH
        config = replace(config, steps=self.steps or config.steps, strength=strength)
        if self.guidance is not None or self.guidance_interval is not None:
            scale = config.guidance.scale if self.guidance is None else self.guidance
            config = replace(
                config, guidance=Guidance(scale=scale, interval=self.guidance_interval)
            )
        if self.cache is not None:
            config = replace(config, cache=StepCache(threshold=self.cache))
        if self.activations_8bit:
            config = replace(config, activations="8bit")
        if self.solver is not None:
            config = replace(config, solver=SOLVERS.parse(self.solver))
        if self.solver == "wan":
            if not isinstance(config.process, RectifiedFlow):
                raise InputError(f"{config.name} is not a rectified flow. (--solver wan)")
            config = replace(config, process=RectifiedFlow.wan_unipc(config.process.shift))
        # Last: its check needs the final solver and process.
        if self.progressive is not None:
            config = replace(config, progressive=Progressive(share=self.progressive))
        return config

    @property
    def _weights(self) -> Path | None:
        """Folder of the weights; None for random weights."""
        from egosim_jax import configs

        if self.weights is None and configs.allows_random_weights(self.config):
            return None
        return configs.weights_of(self.config, self.weights)
