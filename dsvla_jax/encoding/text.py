"""Text to tokens: the tokenizer interface, a small word-level tokenizer, and the grammar of answers over tokens."""

import dataclasses
import functools
import json
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np
from flax import struct

from dsvla_jax.encoding.codec import QUATERNION_VALUES, VALUES_PER_ARM
from dsvla_jax.encoding.prompts import Slot, Style, answer_pieces, template_texts
from dsvla_jax.errors import UserError
from dsvla_jax.types import Array

LOWEST_NUMBER, HIGHEST_NUMBER = -100, 200
_SPECIAL = ("<pad>", "<unk>", "<s>", "</s>")
_FILE_FORMAT = "dsvla_jax word tokenizer 1"


class Tokenizer(Protocol):
    """What the policy asks of a tokenizer. ``encode`` adds no special tokens; ``decode`` leaves them out."""

    @property
    def vocab_size(self) -> int: ...

    @property
    def pad_id(self) -> int: ...

    @property
    def bos_id(self) -> int: ...

    @property
    def eos_id(self) -> int: ...

    def encode(self, text: str) -> list[int]: ...

    def decode(self, tokens: Sequence[int]) -> str: ...


def load_tokenizer(folder: str | pathlib.Path) -> "WordTokenizer":
    """The tokenizer saved in a folder as tokenizer.json; raises UserError where there is none that can be read."""
    file = pathlib.Path(folder) / "tokenizer.json"
    if not file.exists():
        raise UserError(
            f"tokenizer: {file} is missing; expected the vocabulary that the language model was trained with: put it "
            "there, or name its folder with --tokenizer"
        )
    try:
        return WordTokenizer.load(file)
    except ValueError as error:
        raise UserError(f"tokenizer: {error}") from error


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

    def __post_init__(self):
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
        return len(self.pieces)

    @property
    def pad_id(self) -> int:
        return 0

    @property
    def unk_id(self) -> int:
        return 1

    @property
    def bos_id(self) -> int:
        return 2

    @property
    def eos_id(self) -> int:
        return 3

    @property
    def number_values(self) -> np.ndarray:
        """float32 (V,): the value of each integer token, NaN for every other token."""
        values = np.full(self.vocab_size, np.nan, np.float32)
        first = len(_SPECIAL)
        count = HIGHEST_NUMBER - LOWEST_NUMBER + 1
        values[first : first + count] = np.arange(LOWEST_NUMBER, HIGHEST_NUMBER + 1)
        return values

    def encode(self, text: str) -> list[int]:
        return [self._encode_word(word, text) for word in split_words(text)]

    def decode(self, tokens: Sequence[int]) -> str:
        special = (self.pad_id, self.bos_id, self.eos_id)
        return " ".join(self.pieces[int(token)] for token in tokens if int(token) not in special)

    def save(self, path: str | pathlib.Path) -> None:
        """Writes the words as JSON."""
        content = {"format": _FILE_FORMAT, "words": list(self.words)}
        pathlib.Path(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | pathlib.Path) -> "WordTokenizer":
        """Reads what ``save`` wrote."""
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
            return self._ids.get(word, self.unk_id)
        number = str(int(word))
        if number not in self._ids:
            raise ValueError(
                f"number {word} has no token: integers from {LOWEST_NUMBER} to {HIGHEST_NUMBER} have one; in {text!r}"
            )
        return self._ids[number]


@struct.dataclass
class AnswerGrammar:
    """Which tokens an answer may have at each of its L places; the end-of-sequence token is the last place.

    forced: int32 (L,), the only possible token, or -1 where the policy chooses.
    allowed: bool (L, V), True for the tokens that may stand there (one-hot where forced).
    forbidden: int32 (A, L), combinations that no answer has: for each arm the tokens of a quaternion of four zeros,
        which is no rotation; -1 at the other places.
    """

    forced: np.ndarray | Array
    allowed: np.ndarray | Array
    forbidden: np.ndarray | Array


def build_answer_grammar(tokenizer: Tokenizer, num_arms: int, style: Style) -> AnswerGrammar:
    """The grammar of ``prompts.answer_pieces`` over a tokenizer's tokens, for constrained decoding.

    Raises:
        ValueError: an integer of some slot is more than one token, so a slot would not be one place.
    """
    numbers: dict[int, int] = {}
    forced: list[int] = []
    choices: list[list[int]] = []
    for piece in answer_pieces(num_arms, style):
        if isinstance(piece, Slot):
            slot_tokens = []
            for number in range(piece.low, piece.high + 1):
                if number not in numbers:
                    numbers[number] = _single_token(tokenizer, number)
                slot_tokens.append(numbers[number])
            forced.append(-1)
            choices.append(slot_tokens)
        else:
            tokens = tokenizer.encode(piece)
            forced += tokens
            choices += [[token] for token in tokens]
    forced.append(tokenizer.eos_id)
    choices.append([tokenizer.eos_id])
    allowed = np.zeros((len(forced), tokenizer.vocab_size), bool)
    for place, tokens in enumerate(choices):
        allowed[place, tokens] = True
    # NumPy's, not JAX's: the form of an answer must stay concrete when this is called inside a jitted function.
    free = np.flatnonzero(np.asarray(forced) < 0).reshape(num_arms, VALUES_PER_ARM)
    forbidden = np.full((num_arms, len(forced)), -1, np.int32)
    for arm, places in enumerate(free):
        forbidden[arm, places[QUATERNION_VALUES]] = numbers[0]
    return AnswerGrammar(forced=np.asarray(forced, np.int32), allowed=allowed, forbidden=forbidden)


def _single_token(tokenizer: Tokenizer, number: int) -> int:
    tokens = tokenizer.encode(str(number))
    if len(tokens) != 1:
        raise ValueError(
            f"answer grammar: expected one token for each integer, but {number} is {len(tokens)} tokens; "
            "use a tokenizer with integer tokens, such as WordTokenizer"
        )
    return tokens[0]


def _is_number(word: str) -> bool:
    return word.lstrip("-").isdigit()
