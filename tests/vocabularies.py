"""Small tokenizers of the kinds that language models have, trained on the project's own sentences."""

import functools
import io
import json
import tempfile
from pathlib import Path

import numpy as np
import sentencepiece
from tokenizers import Regex, Tokenizer, decoders, pre_tokenizers, trainers
from tokenizers.models import BPE

from dsvla_jax.encoding import text
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.prompts import STYLES, format_answer, format_prompt

# words: each integer a token. sentencepiece: digits apart, as LLaMA's. digits: digits apart, byte-level, as SmolLM2's.
# merged: up to three digits a token, as Llama 3's.
KINDS = ("words", "sentencepiece", "digits", "merged")
BEGIN, END = "<s>", "</s>"
INSTRUCTIONS = ("close the red jar", "lift the tray", "turn on the light")


def sentences() -> list[str]:
    """Prompts with answers that hold every integer of every slot."""
    texts = []
    for number in range(-100, 201):
        capped = min(number, 100)
        integers = np.array([[number] * 3 + [capped] * 3 + [abs(capped), number % 2]] * (1 + number % 2))
        for style in STYLES:
            prompt = format_prompt(INSTRUCTIONS[number % 3], integers, integers[:, :3], style)
            texts.append(f"{prompt} {format_answer(integers, style)}")
    return texts


@functools.cache
def small_tokenizer(kind: str) -> text.Tokenizer:
    """The tokenizer of a kind, through the folder in which a user has one."""
    if kind == "words":
        return text.WordTokenizer(text.vocabulary(INSTRUCTIONS))
    with tempfile.TemporaryDirectory() as folder:
        write_tokenizer(kind, Path(folder))
        return load_tokenizer(folder)


def write_tokenizer(kind: str, folder: Path) -> None:
    """Trains a tokenizer of a kind and writes its folder as a checkpoint has it."""
    if kind == "sentencepiece":
        model = io.BytesIO()
        sentencepiece.SentencePieceTrainer.train(  # pyright: ignore[reportAttributeAccessIssue]
            sentence_iterator=iter(sentences()),
            model_writer=model,
            vocab_size=600,
            model_type="bpe",
            byte_fallback=True,
            split_digits=True,
            normalization_rule_name="identity",
            remove_extra_whitespaces=False,
            minloglevel=2,
        )
        (folder / "tokenizer.model").write_bytes(model.getvalue())
        return
    tokenizer = Tokenizer(BPE(ignore_merges=kind == "merged"))
    bytes_only = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=kind == "digits")
    words = r"[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}{1,3}| ?[^\s\p{L}\p{N}]+|\s+"
    split = {
        "digits": pre_tokenizers.Digits(individual_digits=True),
        "merged": pre_tokenizers.Split(Regex(words), "isolated"),
    }[kind]
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([split, bytes_only])
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=700,
        special_tokens=[BEGIN, END],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(sentences(), trainer)
    tokenizer.save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"bos_token": BEGIN, "eos_token": {"content": END}}))
