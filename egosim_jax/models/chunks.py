"""Chunks of latent frames, which a causal denoiser makes one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

from egosim_jax.types import InputError, check_counts


@dataclass(frozen=True, kw_only=True)
class Chunks:
    """Chunks of a clip, and how a causal denoiser makes them.

    The tokens of a chunk attend to each other and to the finished chunks before it.
    """

    sizes: tuple[int, ...]
    """Latent frames of each chunk."""
    first_steps: int | None = None
    """Denoising steps of the first chunk; None: as many as the other chunks have."""
    refresh: bool = False
    """Compute the keys and values of a finished chunk, which later chunks see, by one more pass.

    Without it, later chunks see the keys and values of the chunk's last denoising step."""

    def __post_init__(self) -> None:
        if not self.sizes:
            raise InputError("A causal denoiser needs at least one chunk. (chunks.sizes)")
        check_counts({f"chunks.sizes[{n}]": size for n, size in enumerate(self.sizes)})
        if self.first_steps is not None:
            check_counts({"chunks.first_steps": self.first_steps})

    @property
    def bounds(self) -> tuple[int, ...]:
        """First latent frame of each chunk, then the number of latent frames of the clip."""
        return tuple(accumulate(self.sizes, initial=0))

    def check(self, frames: int) -> None:
        """Raise `InputError` unless the chunks make a clip of so many latent frames."""
        if sum(self.sizes) != frames:
            raise InputError(
                f"Chunks of {self} latent frames make a clip of {sum(self.sizes)}; the clips have "
                f"{frames}. Change the chunks or the number of frames. (chunks.sizes, video.frames)"
            )

    def __str__(self) -> str:
        """Return the sizes as text."""
        return " + ".join(map(str, self.sizes))
