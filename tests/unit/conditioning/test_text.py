"""Cleaning and tokenizing prompts."""

import numpy as np
import pytest
from tokenizers import Tokenizer, pre_tokenizers, processors
from tokenizers.models import Unigram

from egosim_jax.conditioning.text import PromptTokenizer, clean_prompt
from egosim_jax.types import InputError

WORDS = ("▁a", "▁hand", "▁lifts", "▁the", "▁cup", "▁", "s")


@pytest.mark.parametrize(
    ("dirty", "clean"),
    [
        ("  a\thand \n\n lifts\u00a0a cup ", "a hand lifts a cup"),
        ("a cup &amp;amp; a lid", "a cup & a lid"),
        ("<b>&amp;lt;cup&amp;gt;</b>", "<b><cup></b>"),
        ("the personâ€™s cafÃ©", "the person's café"),
        ("\ufeffa cup\x00", "a cup"),
        ("a\u200bcup", "a\u200bcup"),
        (" \n ", ""),
    ],
    ids=["blanks", "entities", "entities and tags", "mojibake", "control", "zero-width", "none"],
)
def test_prompts_are_cleaned_as_for_the_released_models(dirty, clean):
    assert clean_prompt(dirty) == clean


def test_printable_ascii_without_entities_needs_no_repair():
    import ftfy

    text = "".join(chr(code) for code in range(32, 127) if chr(code) != "&")
    for prompt in (text, text[::-1], "a cup `'quoted'' \\u00e9 \\n <b> #65; a--b"):
        assert ftfy.fix_text(prompt) == prompt
        assert clean_prompt(prompt) == " ".join(prompt.split())


def test_byt5_ids_are_bytes_plus_three_then_one_then_zeros():
    tokens = PromptTokenizer(max_tokens=8).tokenize(["hé", ""])
    assert tokens.ids.tolist() == [[107, 198, 172, 1, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0, 0, 0]]
    assert tokens.mask.sum(axis=1).tolist() == [4, 1]
    assert tokens.ids.dtype == np.int32


def test_byt5_ids_are_those_of_transformers():
    from transformers import ByT5Tokenizer

    theirs = ByT5Tokenizer()
    prompt = "Rechte Hand öffnet die Tür → 門を開ける 🚪"
    ours = PromptTokenizer(max_tokens=80).tokenize([prompt])
    assert ours.ids[0][ours.mask[0]].tolist() == theirs(prompt)["input_ids"]
    assert PromptTokenizer().vocab == len(theirs)


def test_prompts_that_are_too_long_are_cut_before_the_end_token_and_counted():
    tokens = PromptTokenizer(max_tokens=4).tokenize(["abc", "abcd", "abcdefgh"])
    assert tokens.ids.tolist() == [[100, 101, 102, 1]] * 3
    assert tokens.lengths == (4, 5, 9)
    assert tokens.cut == 2
    assert PromptTokenizer(max_tokens=1).tokenize(["abc"]).ids.tolist() == [[1]]


def test_prompts_are_cleaned_before_they_are_tokenized():
    tokens = PromptTokenizer(max_tokens=8).tokenize([" a\n&amp;amp; b "])
    assert bytes(tokens.ids[0, :5].astype(np.uint8) - 3) == b"a & b"


@pytest.fixture
def folder(tmp_path):
    """A umT5 tokenizer in small: <pad> </s> <s> <unk>, words, the 256 bytes as a fallback."""
    pieces = [(name, 0.0) for name in ("<pad>", "</s>", "<s>", "<unk>")]
    pieces += [(word, -2.0) for word in WORDS]
    pieces += [(f"<0x{byte:02X}>", -20.0) for byte in range(256)]
    tokenizer = Tokenizer(Unigram(pieces, unk_id=3, byte_fallback=True))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace(prepend_scheme="always")
    tokenizer.post_processor = processors.TemplateProcessing(
        single="$A </s>", special_tokens=[("</s>", 1)]
    )
    tokenizer.enable_truncation(5)
    tokenizer.enable_padding(length=5)
    tokenizer.save(str(tmp_path / "tokenizer.json"))
    return tmp_path


def test_a_tokenizer_folder_is_read_as_it_was_saved(folder):
    tokenizer = PromptTokenizer(kind=folder, max_tokens=9)
    tokens = tokenizer.tokenize(["a hand lifts the cups", "a"])
    want = [4 + WORDS.index(word) for word in ("▁a", "▁hand", "▁lifts", "▁the", "▁cup", "s")]
    assert tokens.ids.tolist() == [[*want, 1, 0, 0], [4, 1, 0, 0, 0, 0, 0, 0, 0]]
    assert tokens.lengths == (7, 2)
    assert tokenizer.vocab == 4 + len(WORDS) + 256


def test_characters_outside_the_vocabulary_become_bytes_and_not_unknown(folder):
    tokens = PromptTokenizer(kind=folder, max_tokens=6).tokenize(["a ü"])
    blank, first_byte = 4 + WORDS.index("▁"), 4 + len(WORDS)
    assert tokens.ids[0].tolist() == [4, blank, first_byte + 0xC3, first_byte + 0xBC, 1, 0]


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (None, r"tokenizer\.json or spiece\.model.*\(CogVideoX\)"),
        ("{", "not a readable tokenizer"),
        (Tokenizer(Unigram([("<unk>", 0.0), ("a", -1.0)], unk_id=0)).to_str(), "<pad> must be id"),
    ],
    ids=["missing", "damaged", "another family"],
)
def test_a_tokenizer_that_is_missing_damaged_or_of_another_family_is_refused(
    tmp_path, file, message
):
    if file is not None:
        (tmp_path / "tokenizer.json").write_text(file)
    with pytest.raises(InputError, match=message):
        PromptTokenizer(kind=tmp_path).tokenize(["a"])
    with pytest.raises(InputError, match="max_tokens 0"):
        PromptTokenizer(max_tokens=0)
