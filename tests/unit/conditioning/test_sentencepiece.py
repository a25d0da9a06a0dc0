"""Tokenizers read from `spiece.model`."""

import struct

import pytest
from tokenizers import Tokenizer

from egosim_jax.conditioning.sentencepiece import fields, read_spiece
from egosim_jax.conditioning.text import PromptTokenizer
from egosim_jax.types import InputError

NORMAL, UNKNOWN, CONTROL, BYTE = 1, 2, 3, 6
PIECES = [
    ("<pad>", 0.0, CONTROL), ("</s>", 0.0, CONTROL), ("<unk>", 0.0, UNKNOWN),
    ("▁a", -2.0, NORMAL), ("▁hand", -3.0, NORMAL), ("▁lifts", -3.5, NORMAL), ("▁", -4.0, NORMAL),
    ("l", -5.0, NORMAL), ("ift", -5.0, NORMAL), ("s", -5.0, NORMAL), ("▁lift", -3.0, NORMAL),
]  # fmt: skip


def field(number, value):
    """A field of a protocol buffer of at most 127 bytes."""
    if isinstance(value, int):
        return bytes([number << 3, value])
    if isinstance(value, float):
        return bytes([number << 3 | 5]) + struct.pack("<f", value)
    return bytes([number << 3 | 2, len(value)]) + value


def model(pieces=PIECES, kind=1):
    """A unigram model as SentencePiece writes it."""
    written = [
        field(1, field(1, text.encode()) + field(2, score) + field(3, kind))
        for text, score, kind in pieces
    ]
    unknown = b"\xc0\x02\x02"  # field 40: id 2
    return b"".join(written) + field(2, field(3, kind) + unknown) + field(3, field(1, b"identity"))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "spiece.model").write_bytes(model())
    return tmp_path


def test_the_likeliest_pieces_are_taken_and_spaces_join(folder):
    tokenizer = read_spiece(folder / "spiece.model")
    assert tokenizer.encode("a hand  lifts ").tokens == ["▁a", "▁hand", "▁lifts"]
    assert tokenizer.encode("lift").ids == [10]
    assert tokenizer.encode("a z").ids == [3, 6, 2]
    assert tokenizer.get_vocab_size() == len(PIECES) + 100
    assert tokenizer.token_to_id("<extra_id_99>") == len(PIECES)


def test_prompts_are_tokenized_as_by_the_tokenizer_json_of_the_same_model(folder, tmp_path):
    other = tmp_path / "json"
    other.mkdir()
    read_spiece(folder / "spiece.model").save(str(other / "tokenizer.json"))
    Tokenizer.from_file(str(other / "tokenizer.json"))
    prompts = ["a hand lifts a lift", ""]
    ours, theirs = (
        PromptTokenizer(kind=each, clean=False, max_tokens=8).tokenize(prompts)
        for each in (folder, other)
    )
    assert ours.ids.tolist() == theirs.ids.tolist() == [[3, 4, 5, 3, 10, 1, 0, 0], [1] + 7 * [0]]


def test_it_tokenizes_as_the_converter_of_transformers(folder):
    pytest.importorskip("google.protobuf")
    from transformers.convert_slow_tokenizer import T5Converter

    class Slow:
        vocab_file = str(folder / "spiece.model")
        _extra_ids = 100
        legacy = False

        def convert_tokens_to_ids(self, token):
            return 1

    theirs = T5Converter(Slow()).converted()
    ours = read_spiece(folder / "spiece.model")
    for text in ("a hand lifts", "  a   lifts s ", "zz lift", "handa"):
        want = theirs.encode(text, add_special_tokens=False).ids
        assert ours.encode(text, add_special_tokens=False).ids == want


def test_characters_without_a_piece_are_bytes_where_the_model_has_them(tmp_path):
    pieces = [*PIECES, ("<0xC3>", -9.0, BYTE), ("<0xA9>", -9.0, BYTE)]
    (tmp_path / "spiece.model").write_bytes(model(pieces))
    tokenizer = read_spiece(tmp_path / "spiece.model")
    assert tokenizer.encode("a é").ids == [3, 6, len(PIECES), len(PIECES) + 1]


def test_fields_of_all_wire_types_are_read():
    eight, four = bytes(range(8)), bytes(range(4))
    data = b"\x08\xac\x02" + b"\x11" + eight + b"\x1a\x02AB" + b"\x25" + four
    assert list(fields(data)) == [(1, 300), (2, eight), (3, b"AB"), (4, four)]
    assert list(fields(b"\x08" + 9 * b"\xff" + b"\x01")) == [(1, 2**64 - 1)]
    for damaged in (data[:-1], b"\x11" + eight[:7], b"\x08" + 10 * b"\xff" + b"\x01"):
        with pytest.raises(ValueError, match=r"ends in the field|more than 64 bits"):
            list(fields(damaged))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (model(kind=2), "of a model of kind 2"),
        (b"\x0b\x01", "is damaged: wire type 3"),
        *((model()[:cut], None) for cut in (1, 5, 30, 100)),  # it ends early
    ],
)
def test_other_models_and_damaged_files_are_refused(tmp_path, data, message):
    (tmp_path / "spiece.model").write_bytes(data)
    with pytest.raises(InputError, match=message):
        PromptTokenizer(kind=tmp_path).tokenize(["a"])
