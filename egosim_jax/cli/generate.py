"""`egosim generate`: clips from a metadata file of conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from egosim_jax.data.clip_files import Prompts
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.types import InputError, MeshConfig, check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.data.windows import Window


Solver = Literal["euler", "unipc", "wan", "ddim", "dpmpp_2m", "dpmpp_2m_sde"]


@dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate a clip for each row of a metadata file, or for scenes of the tabletop world.

    Writes {id}.mp4, {id}_cmp.mp4 (prior | hands | generated | ground truth), contact_sheet.png (the
    same rows of the first clips), results.jsonl, config.json and environment.json.
    Prints the path of each clip.
    """

    help_groups: ClassVar[HelpGroups] = {
        "clips": ("robot", "limit", "where", "video_id", "start", "prompts", "lenient", "decoding"),
        "sampling": ("steps", "sampling", "strength", "solver", "lora", "lora_scale", "baseline"),
        "run": ("batch_size", "skip_existing", "reconstruct"),
    }
    config: str
    """Name of the model (`egosim models list`)."""
    metadata: Path | None = None
    """CSV or JSONL in EgoSim's columns, or a list of DWM; without it, scenes of the tabletop world.

    The columns are ego_prior_video, hand_keypoint_video, first_frame, prompt, video_id, and video
    if the ground truth is known. Scenes are written to OUT/scenes."""
    robot: bool = False
    """Make the scene with a robot gripper instead of human hands."""
    out: Path | None = None
    """Folder to write to; runs/CONFIG_SEED if not given."""
    weights: Path | None = None
    """Folder of weights, by default those that ship with the package or were fetched.

    The model `debug` has random ones."""
    lora: Path | None = None
    """LoRA of the video transformer, in PEFT's, diffusers', kohya's or ComfyUI's names.

    A file, or DWM's folder of one with weights in full."""
    lora_scale: float | None = None
    """Strength of the LoRA."""
    video_id: tuple[str, ...] = ()
    """Take only these clips."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    limit: int | None = None
    """Maximum number of clips; without metadata, number of scenes, of consecutive seeds."""
    start: Annotated[tuple[int, ...], tyro.conf.arg(metavar="FRAME [FRAME ...]")] = (0,)
    """First frame of the window that is generated; several make several clips, {id}_{frame}."""
    prompts: Prompts = "prompts_rewrite"
    """Captions of a list of DWM.

    prompts_rewrite: the rewritten ones, of the released models, and the original one of a clip that
    has none; prompts: the original ones, of the paper's evaluation."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    sampling: str | None = None
    """Named sampling of the model, such as `released` or `paper` of DWM; None: the default one.

    It may set steps, solver, guidance and prompt; --steps and --solver change it."""
    strength: float | None = None
    """Share of the steps to take, from the prior with that much noise (SDEdit), such as 0.75.

    The prior is then no condition."""
    solver: Solver | None = None
    """Sampler, instead of the model's.

    wan: UniPC with Wan's noise levels and integer timesteps; dpmpp_2m: DPM-Solver++ (2M), whose SDE
    form adds noise at each step."""
    seed: int = 0
    """Seed from which each clip's noise is derived, and without metadata the scene."""
    batch_size: int | None = None
    """Clips generated together, over all devices: a multiple of mesh.data x mesh.fsdp, its default.
    """
    mesh: MeshConfig = field(default_factory=lambda: MeshConfig(data=-1, fsdp=1))
    """Layout of the devices; by default each generates separate clips.

    Less time for one clip: --mesh.data 1 --mesh.context -1. Weights too large for one device:
    --mesh.data 1 --mesh.fsdp -1."""
    lenient: bool = False
    """Repair input as the official loader does.

    It repeats or cuts frames, resizes videos, and treats all pixels as observed without a mask."""
    decoding: Literal["accurate", "official"] = "accurate"
    """Color decoding of videos; official: as in EgoSim's loader, a gray level darker."""
    baseline: Literal["no_hands", "hand_mask", "sdedit"] | None = None
    """Generate a baseline of the model: without hands, with their mask, or by SDEdit.

    SDEdit begins with the noised prior, at the model's strength or 0.75."""
    skip_existing: bool = False
    """Skip clips whose video exists; one that was made of other inputs is refused."""
    reconstruct: bool = False
    """Also write {id}_vae.mp4, the ground truth through the autoencoder: the upper bound."""

    def run(self) -> int:
        """Check everything, compile, generate."""
        from egosim_jax.generation.batch import BatchJob
        from egosim_jax.io.executables import share_with_jax
        from egosim_jax.worlds.tabletop.dataset import write_scenes

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
            static = job.model.layout.mask_packing == "observed"
            scenes = write_scenes(
                job.out / "scenes",
                seeds,
                spec=job.model.video,
                kind=kind,
                prior="static" if static else "state",
                hands="mesh" if static else "skeleton",
            )
            windows = self._windows(scenes)
        outcome = job.generate(windows)
        if outcome.rejected == len(windows):
            return ExitCode.USAGE
        return ExitCode.PARTIAL if outcome.rejected or outcome.failed else ExitCode.DONE

    def _check(self) -> None:
        check_counts(
            {"--steps": self.steps, "--batch-size": self.batch_size, "--limit": self.limit}
        )
        check_seed(self.seed)
        check_seed(self.seed + (self.limit or 0))
        if min(self.start) < 0:
            raise InputError(f"--start must be at least 0, not {min(self.start)}.")
        if self.robot and self.metadata is not None:
            raise InputError(
                "--robot is of the tabletop world: the clips of --metadata have their own hands. "
                "Omit one of them. (--robot, --metadata)"
            )
        if self.prompts != "prompts_rewrite" and self.metadata is None:
            raise InputError(
                f"--prompts {self.prompts} is of a list of DWM: scenes of the tabletop world have "
                "one caption. Give a list, or leave this out. (--prompts, --metadata)"
            )
        if self.lora is None and self.lora_scale is not None:
            raise InputError(
                "--lora-scale is the strength of a LoRA: name its file as well. (--lora)"
            )
        if self.lora is not None and self._weights is None:
            raise InputError(f"--lora needs weights: {self.config} has random ones. (--weights)")

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
        """Return the config of the model with the options applied."""
        from egosim_jax import configs
        from egosim_jax.diffusion import DDIM, DPMSolver, Euler, RectifiedFlow, UniPC
        from egosim_jax.generation.batch import STRENGTH

        config = configs.get(self.config)
        config = config if self.sampling is None else configs.sampled(config, self.sampling)
        config = config if self._weights is None else config.at(self._weights)
        strength = self.strength
        if self.baseline == "sdedit" and strength is None:
            strength = STRENGTH
        config = replace(config, steps=self.steps or config.steps, strength=strength)
        if self.solver is not None:
            solvers = {
                "euler": Euler(),
                "unipc": UniPC(),
                "wan": UniPC(),
                "ddim": DDIM(),
                "dpmpp_2m": DPMSolver(),
                "dpmpp_2m_sde": DPMSolver(stochastic=True),
            }
            config = replace(config, solver=solvers[self.solver])
        if self.solver == "wan":
            if not isinstance(config.process, RectifiedFlow):
                raise InputError(f"{config.name} is not a rectified flow. (--solver wan)")
            config = replace(config, process=RectifiedFlow.wan_unipc(config.process.shift))
        return config

    @property
    def _weights(self) -> Path | None:
        """Folder of the weights; None for random ones."""
        from egosim_jax import configs

        if self.weights is None and configs.allows_random_weights(self.config):
            return None
        return configs.weights_of(self.config, self.weights)
