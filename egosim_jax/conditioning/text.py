"""Prompts to token ids: Wan's cleaning, and two tokenizers of the T5 family.

In both, id 0 pads and id 1 ends a prompt. `byt5` needs no files: the tokens are the UTF-8 bytes
of the prompt, byte x as id x + 3, after the ids for padding, end and unknown (Xue et al. 2022).
A folder in the layout of google/umt5-xxl gives the tokenizer of the released text encoder. Its
`tokenizer.json` is read directly: the T5 class of transformers 5 would rebuild it and lose its byte
fallback and its id for unknown. Without that file, `spiece.model` is read.
"""

from __future__ import annotations

import functools
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Int32

from egosim_jax.conditioning.sentencepiece import read_spiece
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import tokenizers

PAD, END = 0, 1
"""Ids of padding and of the end of a prompt."""
BYTE_OFFSET = 3
"""ByT5's id of byte 0."""
BYT5_VOCAB = 384
"""Ids of ByT5: 3 special ones, 256 bytes, 125 sentinels that prompts do not use."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Tokens:
    """Batch of tokenized prompts, all of one length n."""

    ids: Int32[np.ndarray, "b n"]
    """Token ids, 0 after the end of the prompt."""
    mask: Bool[np.ndarray, "b n"]
    """True on the prompt and its end token."""
    lengths: tuple[int, ...]
    """Tokens of each prompt, its end token included, before it was cut to n."""

    @property
    def cut(self) -> int:
        """Number of prompts that were too long and have lost their last tokens."""
        return sum(length > self.ids.shape[1] for length in self.lengths)


@dataclass(frozen=True, kw_only=True)
class PromptTokenizer:
    """Tokenizer of prompts."""

    kind: Literal["byt5"] | Path = "byt5"
    """`byt5`, or a folder with the tokenizer.json or spiece.model of umT5 or another T5 model."""
    clean: bool = True
    """Repair encodings, HTML entities and white space first, as Wan does and CogVideoX does not."""
    max_tokens: int = 512
    """Tokens that every prompt is padded or cut to, the end token included."""

    def __post_init__(self) -> None:
        if self.max_tokens < 1:
            raise InputError(
                f"max_tokens {self.max_tokens} leaves no room for the end token: it must be at "
                "least 1."
            )

    @property
    def vocab(self) -> int:
        """Number of ids, which the text encoder's vocabulary must hold."""
        return BYT5_VOCAB if self.kind == "byt5" else _read(self.kind).get_vocab_size()

    def tokenize(self, prompts: Sequence[str]) -> Tokens:
        """Clean and tokenize; a prompt that is too long is cut, but keeps its end token.

        Raises `InputError` if the tokenizer folder is missing or is not of the T5 family.
        """
        cleaned = [clean_prompt(prompt) if self.clean else prompt for prompt in prompts]
        if self.kind == "byt5":
            encoded = [[byte + BYTE_OFFSET for byte in text.encode()] for text in cleaned]
        else:
            batch = _read(self.kind).encode_batch(cleaned, add_special_tokens=False)
            encoded = [encoding.ids for encoding in batch]
        ids = np.full((len(encoded), self.max_tokens), PAD, np.int32)
        mask = np.zeros(ids.shape, bool)
        for row, prompt in enumerate(encoded):
            kept = [*prompt[: self.max_tokens - 1], END]
            ids[row, : len(kept)] = kept
            mask[row, : len(kept)] = True
        return Tokens(ids=ids, mask=mask, lengths=tuple(len(prompt) + 1 for prompt in encoded))


def clean_prompt(text: str) -> str:
    """Repair broken encodings, resolve HTML entities twice, make every white space one blank."""
    if not text.isascii() or not text.isprintable() or "&" in text:  # others need no repair
        import ftfy

        text = html.unescape(html.unescape(ftfy.fix_text(text)))
    return re.sub(r"\s+", " ", text).strip()


@functools.cache
def _read(folder: Path) -> tokenizers.Tokenizer:
    from tokenizers import Tokenizer

    file, pieces = folder / "tokenizer.json", folder / "spiece.model"
    if not file.is_file() and pieces.is_file():
        tokenizer = read_spiece(pieces)
        _check_ids(tokenizer, pieces)
        return tokenizer
    if not file.is_file():
        raise InputError(
            f"No tokenizer in {folder}: it must hold the tokenizer.json or spiece.model of the "
            "model's text encoder. Releases have it in google/umt5-xxl (Wan 2.1, EgoSim) or "
            "tokenizer (CogVideoX), from where `egosim convert weights` copies it."
        )
    try:
        tokenizer = Tokenizer.from_file(str(file))
    except Exception as error:  # the library raises bare Exceptions
        raise InputError(f"{file} is not a readable tokenizer: {error}.") from error
    _check_ids(tokenizer, file)
    tokenizer.no_truncation()
    tokenizer.no_padding()
    return tokenizer


def _check_ids(tokenizer: tokenizers.Tokenizer, file: Path) -> None:
    """Raise `InputError` unless padding and end have the ids of the T5 family."""
    for token, want in (("<pad>", PAD), ("</s>", END)):
        if (have := tokenizer.token_to_id(token)) != want:
            raise InputError(
                f"{file} is not a T5-family tokenizer: {token} must be id {want}, not {have}."
            )
