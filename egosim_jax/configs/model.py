"""Config of a model, and the container of its networks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Float

from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.conditioning.posterior import EncodingNoise
from egosim_jax.conditioning.text import PromptTokenizer
from egosim_jax.diffusion.caching import StepCache
from egosim_jax.diffusion.guidance import Guidance
from egosim_jax.diffusion.process import RectifiedFlow, VariancePreserving
from egosim_jax.diffusion.progressive import Progressive
from egosim_jax.diffusion.solver import Euler, Solver
from egosim_jax.io import weights
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.executables import cached_trace
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models import (
    CausalDenoiserConfig,
    ChunkedCodecConfig,
    Denoiser,
    DenoiserConfig,
    ImageEncoder,
    ImageEncoderConfig,
    NetworkConfig,
    TextEncoder,
    TextEncoderConfig,
    VideoCodec,
    VideoCodecConfig,
    abstract,
    eight_bit,
    lora,
)
from egosim_jax.models.chunks import Chunks
from egosim_jax.models.layers import init_sharded
from egosim_jax.models.t5 import UMT5Config
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.rendering import POINT_PX, PriorKind
from egosim_jax.types import InputError, Triplet, VideoGrid, VideoSpec, check_counts

Name = Literal["dit", "vae", "text", "image"]
"""Role of a network in a model, and stem of its weights file."""
NAMES: tuple[Name, ...] = ("dit", "vae", "text", "image")


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Config of a model: its networks, its conditioning and its sampling."""

    numerics_only: ClassVar[tuple[str, ...]] = ("steps",)
    """Fields that may change when a training resumes, because training draws no samples."""
    name: str
    """Name of the model on the command line."""
    video: VideoSpec
    """Length and size of its clips."""
    dit: DenoiserConfig
    """Config of the denoiser."""
    vae: VideoCodecConfig = field(default_factory=WanVAEConfig)
    """Config of the video autoencoder."""
    text: TextEncoderConfig = field(default_factory=UMT5Config)
    """Config of the text encoder."""
    image: ImageEncoderConfig | None = field(default_factory=CLIPVisionConfig)
    """Config of the image encoder; None for models without the image branch."""
    zero_image_tokens: int | None = None
    """Number of image tokens of zeros, for a denoiser without an image encoder (DWM on Wan).

    Training and generation both use them, unless a triplet has `tokens`."""
    layout: ChannelLayout = field(default_factory=ChannelLayout)
    """Input channels of the denoiser."""
    point_px: int = POINT_PX
    """Side of the points of a rendered prior in pixels, in training and in generation.

    Gaps between points of one pixel are closed."""
    prior: PriorKind = "static"
    """Objects in a rendered prior: where the state has them, or on their predicted paths.

    EgoSim and DWM were trained on static priors."""
    tokenizer: PromptTokenizer = field(default_factory=PromptTokenizer)
    """Tokenizer of the prompts."""
    encoders: Literal["frozen", "joint"] = "frozen"
    """Text and image encoders: pretrained (`frozen`), or trained with the denoiser (`joint`)."""
    image_range: Literal["signed", "unit"] = "signed"
    """Range of the input of CLIP's preprocessing; the EgoSim release uses `unit`."""
    posterior: Literal["sampled"] | None = None
    """Latents in training: drawn at each update (`sampled`, DWM), or the means (None)."""
    encoding_noise: EncodingNoise | None = None
    """Noise in the encoding of conditions at generation; None: no noise."""
    process: RectifiedFlow | VariancePreserving = field(default_factory=RectifiedFlow)
    """Path from data to noise, and the quantity that the denoiser predicts."""
    solver: Solver = field(default_factory=Euler)
    """Sampler of the denoising steps."""
    guidance: Guidance = field(default_factory=Guidance)
    """Classifier-free guidance on the text."""
    unconditional_prompt: str | None = None
    """Negative prompt of the unconditional branch; None: embeddings of zeros (EgoSim).

    Training replaces dropped prompts by it.
    """
    strength: float | None = None
    """Fraction of the steps to run, starting from the noised prior (SDEdit).

    The prior is then not a condition. None: all steps, from pure noise."""
    steps: int | tuple[int | float, ...] = 50
    """Number of denoising steps, or the timesteps to visit."""
    cache: StepCache | None = None
    """Reuse of predictions at steps where they would hardly change; None: every step is exact."""
    progressive: Progressive | None = None
    """First steps on half the latent grid; None: every step is on the whole grid."""
    chunks: Chunks | None = None
    """Chunks that the denoiser makes one after the other, a causal student; None: all at once."""
    activations: Literal["8bit"] | None = None
    """Activations of a denoiser with weights in 8 bits: also 8 bits, or None: the compute dtype."""

    def __post_init__(self) -> None:
        check_counts({"point_px": self.point_px})
        dit, layout, latents = self.dit, self.layout, self.vae.latent_channels
        pairs = [
            ("dit.text_dim", dit.text_dim, "text.dim", self.text.dim),
            ("dit.out_channels", dit.out_channels, "vae.latent_channels", latents),
            *self._image_sizes(),
            ("dit.in_channels", dit.in_channels, "layout.channels", layout.channels),
        ]
        for part in ("noisy", "prior", "hands"):
            if part in layout:
                channels = layout.count(part)
                pairs.append((f"layout {part}", channels, "vae.latent_channels", latents))
        if "mask" in layout and layout.mask_packing == "time":
            stride = self.vae.temporal_stride
            pairs.append(("layout mask", layout.count("mask"), "vae.temporal_stride", stride))
        for left, a, right, b in pairs:
            if a != b:
                raise InputError(f"{self.name}: {left} is {a} but {right} is {b}; they must agree.")
        if "mask" in layout and layout.mask_packing == "space" and self.vae.spatial_stride % 2:
            raise InputError(
                f"{self.name}: the mask packing `space` takes 2 x 2 pixels of a latent cell, so "
                f"the codec's stride must be even, not {self.vae.spatial_stride}. Choose another "
                "packing. (layout.mask_packing)"
            )
        if dit.patch[1] != dit.patch[2]:
            raise InputError(
                f"{self.name}: the tokens have {dit.patch[1]} rows and {dit.patch[2]} columns; "
                "they must be square. (dit.patch)"
            )
        # Raises if the solver does not fit the process or the steps.
        self.solver.coefficients(self.process, self.process.times(self.visited))
        if isinstance(self.vae, ChunkedCodecConfig):
            self.vae.check_frames(self.video.frames)
        self.grid.check(self.video)
        frames, patch = self.latent_shape[0], dit.patch[0]
        if frames % patch:
            raise InputError(
                f"{self.name}: {frames} latent frames do not divide into tokens of {patch}. Change "
                "the number of frames. (video.frames, dit.patch)"
            )
        if self.chunks is not None:
            self._check_causal(self.chunks)
        if self.progressive is not None:
            self._check_progressive(self.progressive)

    def _check_progressive(self, progressive: Progressive) -> None:
        """Raise `InputError` unless the denoiser and the sampler allow steps on half the grid."""
        if not getattr(self.dit, "half_grid", False):
            raise InputError(
                f"{self.name}: the denoiser of {type(self.dit).__name__} does not run on half its "
                "grid. Omit the steps there. (--progressive)"
            )
        steps = len(self.process.times(self.visited)) - 1
        _, *cells = self.latent_shape
        progressive.check(self.process, self.solver, steps, cells, self.dit.patch[1])

    def _check_causal(self, chunks: Chunks) -> None:
        """Raise `InputError` for what a causal student cannot do."""
        chunks.check(self.latent_shape[0])
        if not isinstance(self.dit, CausalDenoiserConfig):
            raise InputError(
                f"{self.name}: the denoiser of {type(self.dit).__name__} is not causal, so it "
                f"cannot make chunks of {chunks} latent frames one after the other. Omit them, to "
                "make clips at once. (chunks)"
            )
        for option, value, usual in (
            ("guidance.scale", self.guidance.scale, 1.0),
            ("strength", self.strength, None),
            ("encoding_noise", self.encoding_noise, None),
            ("cache", self.cache, None),
            ("progressive", self.progressive, None),
        ):
            if value != usual:
                raise InputError(
                    f"{self.name} makes clips chunk by chunk, which supports only {option} "
                    f"{usual}, not {value}. ({option}, chunks)"
                )

    def _image_sizes(self) -> list[tuple[str, int | None, str, int | None]]:
        """Return the pair of widths of the image tokens, which must agree."""
        given = None if self.image is None else self.image.dim
        if self.zero_image_tokens is None:
            return [("dit.image_dim", self.dit.image_dim, "image.dim", given)]
        check_counts({"zero_image_tokens": self.zero_image_tokens})
        if self.image is not None or self.dit.image_dim is None:
            raise InputError(
                f"{self.name}: image tokens of zeros need a denoiser with an image branch and a "
                f"model without an image encoder; there are {self.zero_image_tokens} of them with "
                f"image.dim {given} and dit.image_dim {self.dit.image_dim}. (zero_image_tokens)"
            )
        return []

    @property
    def visited(self) -> int | tuple[int | float, ...]:
        """Number of denoising steps or, with a strength, the timesteps to visit.

        Raises `InputError` for a strength outside (0, 1], or for a model without a prior.
        """
        if self.strength is None:
            return self.steps
        if not 0 < self.strength <= 1 or "prior" not in self.layout:
            raise InputError(
                f"{self.name} cannot start from its prior with strength {self.strength}: it "
                "must be above 0 and at most 1, and the model must have a prior. (--strength)"
            )
        levels = self.process.exact_timesteps(self.process.times(self.steps)[:-1])
        skipped = len(levels) - max(1, int(self.strength * len(levels)))
        kind = int if isinstance(self.process, VariancePreserving) else float
        return tuple(kind(level) for level in levels[skipped:])

    @property
    def image_tokens(self) -> int:
        """Number of image tokens that the denoiser gets."""
        return self.zero_image_tokens or (0 if self.image is None else self.image.tokens)

    def given_image(self, triplets: Sequence[Triplet]) -> Float[np.ndarray, "b m e"] | None:
        """Return the image tokens of clips, or zeros; None without `zero_image_tokens`."""
        zeros = self.zero_image(len(triplets))
        if zeros is None:
            return None
        for row, triplet in zip(zeros, triplets, strict=True):
            if triplet.tokens is not None:
                row[:] = triplet.tokens
        return zeros

    def zero_image(self, batch: int) -> Float[np.ndarray, "b m e"] | None:
        """Return image tokens of zeros for a batch; None without `zero_image_tokens`."""
        if self.zero_image_tokens is None:
            return None
        return np.zeros((batch, self.zero_image_tokens, self.dit.image_dim or 0), np.float32)

    @property
    def grid(self) -> VideoGrid:
        """Latent grid of the model's videos."""
        return VideoGrid(
            temporal_stride=self.vae.temporal_stride,
            spatial_stride=self.vae.spatial_stride,
            patch=self.dit.patch[1],
        )

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns of a clip's latents."""
        return self.grid.latent_shape(self.video)

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip; a model that makes clips at once has one chunk."""
        if self.chunks is None:
            return (self.video.frames,)
        # The first latent frame of a clip encodes one frame.
        stride, (first, *others) = self.vae.temporal_stride, self.chunks.sizes
        return (1 + stride * (first - 1), *(stride * size for size in others))

    @property
    def networks(self) -> Mapping[Name, NetworkConfig]:
        """Configs of the networks that the model has, by name."""
        configs: dict[Name, NetworkConfig | None] = {name: getattr(self, name) for name in NAMES}
        return {name: config for name, config in configs.items() if config is not None}

    @property
    def trained_networks(self) -> tuple[Name, ...]:
        """Names of the networks that training the denoiser updates."""
        trained = ("dit", "text", "image") if self.encoders == "joint" else ("dit",)
        return tuple(name for name in self.networks if name in trained)

    @property
    def cached_networks(self) -> tuple[Name, ...]:
        """Names of the networks whose outputs are cached before the denoiser is trained."""
        return tuple(name for name in self.networks if name not in self.trained_networks)

    def at(self, folder: Path) -> ModelConfig:
        """Return this config with the tokenizer's files looked up in a weights folder."""
        if self.tokenizer.kind == "byt5" or self.tokenizer.kind.is_relative_to(folder):
            return self
        files = replace(self.tokenizer, kind=folder / self.tokenizer.kind)
        return replace(self, tokenizer=files)


class Networks(nnx.Module):
    """Networks of a model; the attribute of an absent network is None."""

    dit: Denoiser
    vae: VideoCodec
    text: TextEncoder
    image: ImageEncoder | None
    chunks: Chunks | None
    """Chunks of a causal denoiser."""

    def __init__(
        self,
        *,
        dit: Any = None,
        vae: Any = None,
        text: Any = None,
        image: Any = None,
        chunks: Chunks | None = None,
    ):
        self.dit, self.vae, self.text, self.image = dit, vae, text, image
        self.chunks = chunks

    @classmethod
    def build(
        cls, config: ModelConfig, *, only: Collection[str] | None = None, rngs: nnx.Rngs
    ) -> Networks:
        """Build the networks of a config, or `only` some by name, with random weights."""
        return cls(
            **{
                name: network.build(rngs=rngs)
                for name, network in config.networks.items()
                if only is None or name in only
            },
            chunks=config.chunks,
        )

    @classmethod
    def abstract(cls, config: ModelConfig, *, only: Collection[str] | None = None) -> Networks:
        """Build the networks with shapes in place of weights."""
        return cls(
            **{
                name: cached_trace(("abstract", network), partial(abstract, network))
                for name, network in config.networks.items()
                if only is None or name in only
            }
        )

    @classmethod
    def random(cls, config: ModelConfig, *, seed: int) -> Networks:
        """Build untrained networks."""
        graph = nnx.graphdef(cls.abstract(config))

        def make(key: jax.Array) -> nnx.State:
            return nnx.state(cls.build(config, rngs=nnx.Rngs(key)), nnx.Param)

        params = init_sharded(make, jax.random.key(seed))
        return nnx.merge(graph, params)

    @classmethod
    def load(
        cls,
        config: ModelConfig,
        folder: Path | str,
        *,
        only: Collection[str] | None = None,
        mesh: Mesh | None = None,
    ) -> Networks:
        """Load networks from a weights folder, which holds `<network>.safetensors` for each.

        On a mesh, each device reads only its own part of the weights. Raises `InputError` with
        every path that is missing, unknown or of another shape, or if the denoiser makes other
        chunks. A student may be a LoRA of the folder's denoiser, in `student.safetensors`. Linear
        layers that a file has in 8 bits compute with them (`models/eight_bit.py`).
        """
        networks, folder = cls.abstract(config, only=only), Path(folder)
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder of weights. (--weights)")
        weights.check_record(folder, networks.parts().keys())
        for name, network in networks.parts().items():
            file = folder / f"{name}.safetensors"
            student = None
            if name == "dit" and file.is_file():
                student = weights.student_of(file, metadata_of(name, config.chunks))
                if student is not None:
                    eight_bit.check_lora(folder)
            cls._adapt(network, file, config.activations if name == "dit" else None)
            weights.load(file, network, mesh=mesh)
            if student is not None:
                lora.merge(network, student, base=weights.hashes(folder, only=["dit"])["dit"])
        return networks

    @staticmethod
    def _adapt(network: nnx.Module, file: Path, activations: str | None) -> None:
        """Give a network the 8-bit layers of its file, if any."""
        layers = weights.layers_in_8_bits(read_safetensors(file)) if file.is_file() else {}
        if activations and file.is_file() and not layers:
            raise InputError(
                f"8-bit activations need weights in 8 bits, and {quote_path(file)} has others. "
                "Convert them (egosim convert quantize), or omit the option. "
                "(--activations-8bit)"
            )
        eight_bit.adapt(network, layers, activations=activations is not None)

    def save(self, folder: Path | str, *, dtype: str | None = None) -> None:
        """Write a weights folder, cast to `dtype` if given."""
        for name, network in self.parts().items():
            metadata = metadata_of(name, self.chunks)
            weights.save(
                Path(folder) / f"{name}.safetensors", network, dtype=dtype, metadata=metadata
            )

    def parts(self) -> dict[str, nnx.Module]:
        """Return the networks that are present, by name."""
        named = {name: getattr(self, name) for name in NAMES}
        return {name: network for name, network in named.items() if network is not None}


def metadata_of(network: str, chunks: Chunks | None) -> dict[str, str]:
    """Return the text metadata of a network's weights: the chunks of a causal denoiser."""
    return {} if chunks is None or network != "dit" else {weights.CHUNKS: str(chunks)}
