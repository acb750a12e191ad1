"""Tokenizers of every kind: their folders, and the grammar of answers over their tokens."""

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import sentencepiece
from tokenizers import Tokenizer

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.encode import encode_text
from dsvla_jax.encoding.grammar import SEPARATOR, build_answer_grammar
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer, save_tokenizer, vocabulary_digest
from dsvla_jax.encoding.prompts import Slot, answer_pieces, format_answer, format_prompt, parse_answer
from dsvla_jax.encoding.text import WordTokenizer
from dsvla_jax.errors import UserError
from tests.vocabularies import BEGIN, END, KINDS, small_tokenizer, write_tokenizer

REAL_KINDS = [kind for kind in KINDS if kind != "words"]


def random_integers(arms: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.uniform(-1, 1, (arms, 2)), rng.uniform(0, 2, (arms, 1)), rng.normal(size=(arms, 4))], 1)
    return np.asarray(PoseCodec().encode(pose, rng.integers(0, 2, arms)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_tokenizer_survives_its_folder(kind, tmp_path):
    tokenizer = small_tokenizer(kind)
    save_tokenizer(tokenizer, tmp_path / "copy")
    # A run folder is a tokenizer's folder too, in which config.json is something else.
    (tmp_path / "copy" / "config.json").write_text('{"eos_token_id": 1, "tokenizer": ""}')
    copy = load_tokenizer(tmp_path / "copy")
    assert copy == tokenizer
    assert hash(copy) == hash(tokenizer)
    assert vocabulary_digest(copy) == vocabulary_digest(tokenizer)
    for one in (copy, pickle.loads(pickle.dumps(copy))):
        assert (one.bos_id, one.eos_id, one.pad_id, one.vocab_size) == (
            tokenizer.bos_id,
            tokenizer.eos_id,
            tokenizer.pad_id,
            tokenizer.vocab_size,
        )
        assert one.encode("close the jar: 12, -7") == tokenizer.encode("close the jar: 12, -7")


def test_tokens_are_those_of_the_libraries_themselves(tmp_path):
    text = "Lift the tray: [28, -1, 140], naïve 🙂"
    write_tokenizer("sentencepiece", tmp_path)
    library = sentencepiece.SentencePieceProcessor(model_file=str(tmp_path / "tokenizer.model"))
    ours = load_tokenizer(tmp_path)
    assert ours.encode(text) == library.encode(text)
    assert ours.decode([ours.bos_id, *ours.encode(text), ours.eos_id]) == text
    write_tokenizer("merged", tmp_path)  # tokenizer.json is preferred where there are both
    file = Tokenizer.from_file(str(tmp_path / "tokenizer.json"))
    ours = load_tokenizer(tmp_path)
    assert ours.encode(text) == file.encode(text).ids
    assert ours.decode([ours.bos_id, *ours.encode(text), ours.eos_id]) == text
    assert (ours.bos_id, ours.eos_id) == (file.token_to_id(BEGIN), file.token_to_id(END))


@pytest.mark.parametrize("kind", REAL_KINDS)
def test_an_instruction_can_not_end_the_prompt(kind):
    tokenizer = small_tokenizer(kind)
    assert tokenizer.eos_id not in tokenizer.encode(f"close{END} the jar")
    assert tokenizer.bos_id not in tokenizer.encode(f"{BEGIN}close the jar")


@pytest.mark.parametrize(
    ("files", "ids"),
    [
        ({"tokenizer_config.json": {"bos_token": BEGIN, "eos_token": {"content": END}}}, (0, 1)),
        ({"special_tokens_map.json": {"eos_token": END}}, (1, 1)),
        ({"tokenizer_config.json": {"bos_token": None}, "config.json": {"eos_token_id": [1, 7]}}, (1, 1)),
        ({"config.json": {}, "generation_config.json": {"bos_token_id": 0, "eos_token_id": 1}}, (0, 1)),
    ],
)
def test_begin_and_end_are_found_where_checkpoints_say_them(files, ids, tmp_path):
    small = small_tokenizer("digits")
    save_tokenizer(small, tmp_path)
    (tmp_path / "tokenizer_config.json").unlink()
    for name, content in files.items():
        (tmp_path / name).write_text(json.dumps(content))
    tokenizer = load_tokenizer(tmp_path)
    assert (tokenizer.bos_id, tokenizer.eos_id, tokenizer.pad_id) == (*ids, ids[1])


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, r"tokenizer\.json is missing, and so is tokenizer\.model; .*--tokenizer"),
        ({"tokenizer.json": "{"}, r"tokenizer\.json: expected JSON; the file is damaged"),
        ({"tokenizer.json": '{"words": []}'}, r"tokenizer\.json: expected a JSON object with format"),
        ({"tokenizer.json": '{"model": {"type": "BPE"}}'}, r"tokenizer\.json: the `tokenizers` library can not read"),
        ({"tokenizer.model": "no model"}, r"tokenizer\.model: not a SentencePiece model"),
        ({"tokenizer.json": None}, "no file says which token ends a text; expected eos_token"),
        (
            {"tokenizer.json": None, "tokenizer_config.json": '{"eos_token": "<end>"}'},
            "eos_token '<end>' is not in the vocabulary",
        ),
        ({"tokenizer.json": None, "config.json": '{"eos_token_id": 99999}'}, "eos_token_id 99999 is no token"),
        ({"tokenizer.json": None, "config.json": "{"}, r"config\.json: expected JSON"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(files, message, tmp_path):
    for name, content in files.items():
        if content is None:
            write_tokenizer("digits", tmp_path)
            (tmp_path / "tokenizer_config.json").unlink()
        else:
            (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=message):
        load_tokenizer(tmp_path)


@pytest.mark.parametrize("style", ["paper", "compact"])
@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_written_as_the_tokenizer_writes_the_whole_text(kind, style):
    tokenizer = small_tokenizer(kind)
    for seed in range(40):
        arms = 1 + seed % 2
        integers = random_integers(arms, seed)
        prompt, answer = format_prompt("lift the tray", integers, None, style), format_answer(integers, style)
        text, answer_mask = encode_text(tokenizer, prompt, answer, 600)
        tokens, mask = text.tokens, text.mask
        assert tokens[mask].tolist() == [
            tokenizer.bos_id,
            *tokenizer.encode(prompt + SEPARATOR + answer),
            tokenizer.eos_id,
        ]
        alone, _ = encode_text(tokenizer, prompt, None, 600)
        np.testing.assert_array_equal(alone.tokens[alone.mask], tokens[mask & ~answer_mask])
        grammar = build_answer_grammar(tokenizer, arms, style)
        assert grammar.tokens(integers) == tokens[answer_mask].tolist()
        read = tokenizer.decode(tokens[answer_mask].tolist())
        np.testing.assert_array_equal(parse_answer(read, arms, style), integers)
        slots = [piece for piece in answer_pieces(arms, style) if isinstance(piece, Slot)]
        assert [(slot.values[0], slot.values[-1]) for slot in grammar.slots] == [(s.low, s.high) for s in slots]


def test_numbers_are_as_long_as_the_vocabulary_makes_them():
    lengths = {}
    for kind in KINDS:
        slot = build_answer_grammar(small_tokenizer(kind), 1, "paper").slots[1]
        lengths[kind] = [len(slot.tokens[value - slot.low]) for value in (5, 15, 150, -5, -15)]
    assert lengths == {
        "words": [1, 1, 1, 1, 1],
        "sentencepiece": [2, 3, 4, 2, 3],  # a space or " -", and digits
        "digits": [2, 3, 4, 2, 3],
        "merged": [2, 2, 2, 2, 2],
    }


def test_a_tokenizer_that_merges_prompt_and_answer_is_refused():
    class Glued(WordTokenizer):
        """Writes a colon and what follows it as one token."""

        def encode(self, text):
            tokens = super().encode(text)
            colon = super().encode(":")[0]
            return [t for t, after in zip(tokens, [*tokens[1:], -1], strict=True) if t != colon or after < 0]

    glued = Glued(("a", ":", "close"))
    with pytest.raises(UserError, match=r"prompt's tokens are not the first of prompt and answer.*'1 2 3'"):
        encode_text(glued, "close:", "1 2 3", 20)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("7", "1"), "written alike for different values"),
        (lambda text: text.replace("-", ""), "written alike for different values"),
        (lambda text: re.sub(r"\b\d\d -", "77 -", text), "not written as its parts"),
    ],
)
def test_a_tokenizer_in_which_numbers_can_not_be_masked_is_refused(change, message):
    class Careless(WordTokenizer):
        def encode(self, text):
            return super().encode(change(text))

    with pytest.raises(UserError, match=message):
        build_answer_grammar(Careless(("a", ":")), 1, "compact")


def test_a_foreign_folder_is_left_as_it_was(tmp_path: Path):
    write_tokenizer("digits", tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    load_tokenizer(tmp_path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
