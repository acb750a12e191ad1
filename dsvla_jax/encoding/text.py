"""Text to tokens: the tokenizer interface, and a small word-level tokenizer."""

import dataclasses
import functools
import json
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from dsvla_jax.encoding.prompts import template_texts
from dsvla_jax.errors import UserError

LOWEST_NUMBER, HIGHEST_NUMBER = -100, 200
_SPECIAL = ("<pad>", "<unk>", "<s>", "</s>")
_FILE_FORMAT = "dsvla_jax word tokenizer 1"


@runtime_checkable
class Tokenizer(Protocol):
    """What the policy asks of a tokenizer. Hashable, equal where the vocabulary is.

    ``encode`` adds no special tokens; ``decode`` leaves them out. ``save`` writes a folder that
    ``pretrained_tokenizers.load_tokenizer`` reads.
    """

    @property
    def vocab_size(self) -> int:
        """V: how many tokens there are."""
        ...

    @property
    def pad_id(self) -> int:
        """The token of padding."""
        ...

    @property
    def bos_id(self) -> int:
        """The token that begins a text."""
        ...

    @property
    def eos_id(self) -> int:
        """The token that ends a text."""
        ...

    def encode(self, text: str) -> list[int]:
        """A text's tokens."""
        ...

    def decode(self, tokens: Sequence[int]) -> str:
        """The text of tokens."""
        ...

    @property
    def number_values(self) -> np.ndarray | None:
        """float32 (V,): the value of each token that is an integer of its own, NaN elsewhere; None for none."""
        ...

    def save(self, folder: pathlib.Path) -> None:
        """Writes a tokenizer's folder."""
        ...


def split_words(text: str) -> list[str]:
    """Lower-case words, integers with their sign, and single punctuation signs; white space only separates."""
    return re.findall(r"-?\d+|[^\W\d]+|[^\w\s]", text.lower())


def vocabulary(instructions: Iterable[str]) -> tuple[str, ...]:
    """Every word and sign of the prompt templates and of ``instructions``, sorted, without numbers."""
    words = {word for text in (*template_texts(), *instructions) for word in split_words(text)}
    return tuple(sorted(word for word in words if not _is_number(word)))


@dataclasses.dataclass(frozen=True)
class WordTokenizer:
    """One token a word, a sign, or an integer from -100 to 200. Same words, same ids: it holds no other state.

    Ids: the special tokens, the integers in ascending order, then ``words`` in the order given. A word that is not
    among them becomes <unk>; an integer out of range is an error, since the answer would silently lose its meaning.
    """

    words: tuple[str, ...]

    def __post_init__(self) -> None:
        wrong = [word for word in self.words if _is_number(word) or split_words(word) != [word]]
        if wrong or len(set(self.words)) != len(self.words):
            raise ValueError(f"WordTokenizer: expected distinct single lower-case words, use vocabulary(); got {wrong}")

    @functools.cached_property
    def pieces(self) -> tuple[str, ...]:
        """The text of every token, by its id."""
        return (*_SPECIAL, *map(str, range(LOWEST_NUMBER, HIGHEST_NUMBER + 1)), *self.words)

    @functools.cached_property
    def _ids(self) -> dict[str, int]:
        return {piece: index for index, piece in enumerate(self.pieces)}

    @property
    def vocab_size(self) -> int:
        """See `Tokenizer`; likewise the rest."""
        return len(self.pieces)

    @property
    def pad_id(self) -> int:
        """<pad>."""
        return 0

    @property
    def unk_id(self) -> int:
        """<unk>."""
        return 1

    @property
    def bos_id(self) -> int:
        """<s>."""
        return 2

    @property
    def eos_id(self) -> int:
        """</s>."""
        return 3

    @property
    def number_values(self) -> np.ndarray:
        """float32 (V,): the value of each integer token, NaN for every other token."""
        values = np.full(self.vocab_size, np.nan, np.float32)
        first = len(_SPECIAL)
        count = HIGHEST_NUMBER - LOWEST_NUMBER + 1
        values[first : first + count] = np.arange(LOWEST_NUMBER, HIGHEST_NUMBER + 1)
        return values

    def knows(self, word: str) -> bool:
        """Whether a word, sign or number of `split_words` has a token of its own."""
        # As a float, since `int` refuses thousands of digits.
        return word in self._ids or (_is_number(word) and LOWEST_NUMBER <= float(word) <= HIGHEST_NUMBER)

    def encode(self, text: str) -> list[int]:
        """A text's tokens. Raises ValueError for an integer out of range."""
        ids = self._ids
        return [ids[word] if word in ids else self._encode_word(word, text) for word in split_words(text)]

    def decode(self, tokens: Sequence[int]) -> str:
        """The words, separated by spaces."""
        special = (self.pad_id, self.bos_id, self.eos_id)
        return " ".join(self.pieces[int(token)] for token in tokens if int(token) not in special)

    def save(self, folder: pathlib.Path) -> None:
        """Writes the words as JSON, in the folder's tokenizer.json."""
        content = {"format": _FILE_FORMAT, "words": list(self.words)}
        (folder / "tokenizer.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | pathlib.Path) -> "WordTokenizer":
        """Reads the file that ``save`` wrote."""
        try:
            content = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: expected a tokenizer saved by WordTokenizer.save, but it is not JSON") from error
        if not isinstance(content, dict) or content.get("format") != _FILE_FORMAT:
            raise ValueError(
                f"{path}: expected a JSON object with format {_FILE_FORMAT!r}, as WordTokenizer.save writes"
            )
        return cls(tuple(content["words"]))

    def _encode_word(self, word: str, text: str) -> int:
        if not _is_number(word):
            return self.unk_id
        if not self.knows(word):
            raise UserError(
                f"number {word} has no token: integers from {LOWEST_NUMBER} to {HIGHEST_NUMBER} have one; in {text!r}"
            )
        return self._ids[str(int(word))]


def unknown_words(texts: Iterable[str], tokenizer: Tokenizer) -> list[str]:
    """The words and numbers of the texts that have no token, sorted; a subword tokenizer knows every one."""
    if not isinstance(tokenizer, WordTokenizer):
        return []
    return sorted({word for text in texts for word in split_words(text) if not tokenizer.knows(word)})


def require_known_words(instruction: str, tokenizer: Tokenizer) -> None:
    """Raises UserError if a policy's instruction has a word or number that no token stands for."""
    if unknown := unknown_words([instruction], tokenizer):
        raise UserError(
            f"the policy's vocabulary has no token for {quoted(unknown)}; expected words that the policy was trained "
            "with"
        )


def check_words(where: object, texts: Iterable[str], tokenizer: Tokenizer, command: str) -> None:
    """Raises UserError if a word or number of a text has no token. command: what writes a vocabulary with the words."""
    unknown = unknown_words(texts, tokenizer)
    if numbers := [word for word in unknown if _is_number(word)]:
        raise UserError(
            f"{where}: the vocabulary has no token for {quoted(numbers)}: integers from {LOWEST_NUMBER} to "
            f"{HIGHEST_NUMBER} have one; write other numbers in words, or use a language model with its own tokenizer"
        )
    if unknown:
        raise UserError(
            f"{where}: the vocabulary has no token for {quoted(unknown)}; write one with `{command}`, and train with"
            " the options that it prints"
        )


def quoted(words: Sequence[str]) -> str:
    """The first five words in quotation marks, and how many more there are."""
    return ", ".join(map(repr, words[:5])) + (f" and {len(words) - 5} more" if len(words) > 5 else "")


def _is_number(word: str) -> bool:
    # Decimal digits only, as in `split_words`: "²" and "②" are digits too, but `int` does not read them.
    return word.lstrip("-").isdecimal()
