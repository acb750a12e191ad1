"""The form of an answer over a tokenizer's tokens: fixed tokens, and between them numbers of one or several tokens.

An answer has one tokenisation only, the tokenizer's own of the whole text. `build_answer_grammar` takes it apart into
templates and numbers, whatever the tokenizer does with signs, brackets and digits around them (in LLaMA's vocabulary
" [28" is " [", "2", "8", and " [-28" is " [-", "2", "8"), and proves on the tokenizer that the parts make the whole.
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from dsvla_jax.encoding.codec import QUATERNION_VALUES, VALUES_PER_ARM
from dsvla_jax.encoding.prompts import (
    ParseFailure,
    Slot,
    Style,
    answer_pieces,
    format_answer,
    format_prompt,
    parse_answer,
)
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError

Tokens = tuple[int, ...]

# Between a prompt and its answer. Without it some vocabularies merge the prompt's ":" with the answer's first token
# (Llama 3's has ":The", LLaMA's has ":-"), and the prompt would not be a prefix of prompt and answer.
SEPARATOR = " "
_CHECKED_ANSWERS = 100


@dataclasses.dataclass(frozen=True)
class NumberSlot:
    """Where one number of the answer stands.

    low: the smallest. tokens: of low, low + 1 and so on, each the one way in which it is written there; different
        ones may have different lengths, and hold what the tokenizer merges with the number.
    ends: the tokens that may come after the number.
    """

    low: int
    tokens: tuple[Tokens, ...]
    ends: Tokens

    @property
    def values(self) -> range:
        """The integers, in ascending order."""
        return range(self.low, self.low + len(self.tokens))


@dataclasses.dataclass(frozen=True)
class AnswerGrammar:
    """An answer is templates[0], a number, templates[1], a number ... templates[-1], the end-of-sequence token last."""

    templates: tuple[Tokens, ...]
    slots: tuple[NumberSlot, ...]

    @property
    def num_arms(self) -> int:
        """A: how many arms an answer is for."""
        return len(self.slots) // VALUES_PER_ARM

    def tokens(self, integers: np.ndarray) -> list[int]:
        """Action integers (A, 8) -> the answer's tokens with the end-of-sequence token."""
        answer = list(self.templates[0])
        for value, slot, template in zip(integers.ravel(), self.slots, self.templates[1:], strict=True):
            answer += (*slot.tokens[value - slot.low], *template)
        return answer


def tokenize_answer(tokenizer: Tokenizer, prompt: str, answer: str) -> tuple[list[int], list[int]]:
    """A prompt's tokens and its answer's, without begin and end: together those of the whole text.

    Raises UserError where the prompt's tokens are not the first of the whole text's.
    """
    asked, whole = tokenizer.encode(prompt), tokenizer.encode(prompt + SEPARATOR + answer)
    if whole[: len(asked)] != asked:
        raise UserError(
            "tokenizer: the prompt's tokens are not the first of prompt and answer, so a policy that has read the "
            f"prompt could not write this answer: {tokenizer.decode(asked[-3:])!r} becomes "
            f"{tokenizer.decode(whole[len(asked) - 3 : len(asked)])!r} when {answer[:20]!r} follows. Use a tokenizer "
            "that splits text between words"
        )
    return asked, whole[len(asked) :]


@functools.cache
def build_answer_grammar(tokenizer: Tokenizer, num_arms: int, style: Style) -> AnswerGrammar:
    """The grammar of ``prompts.answer_pieces`` over a tokenizer's tokens.

    Raises UserError, saying where, if an answer's numbers can not be told apart from the text around them, or if the
    tokenizer does not write an answer as its parts: then no decoder could mask number by number.
    """
    limits = [piece for piece in answer_pieces(num_arms, style) if isinstance(piece, Slot)]
    # All zeros but for the quaternions, which have to be rotations.
    reference = np.zeros((num_arms, VALUES_PER_ARM), int)
    reference[:, QUATERNION_VALUES] = 1
    whole = _write(tokenizer, reference, style)
    numbers, borders = [], [0]
    for index, limit in enumerate(limits):
        written = []
        for value in range(limit.low, limit.high + 1):
            answer = reference.copy()
            answer.flat[index] = value
            written.append(_write(tokenizer, answer, style))
        first = _common_prefix(written)
        # Nothing of the beginning belongs to the end as well.
        last = _common_prefix([tokens[first:][::-1] for tokens in written])
        numbers.append(tuple(tuple(tokens[first : len(tokens) - last]) for tokens in written))
        borders += [first, len(whole) - last]
    borders.append(len(whole))
    if sorted(borders) != borders:
        raise _unseparable(tokenizer, "the tokens of neighbouring numbers overlap", whole)
    templates = [tuple(whole[start:end]) for start, end in zip(borders[::2], borders[1::2], strict=True)]
    templates[-1] = (*templates[-1], tokenizer.eos_id)
    slots = []
    for index, (limit, tokens) in enumerate(zip(limits, numbers, strict=True)):
        following = templates[index + 1]
        ends = {following[0]} if following else {number[0] for number in numbers[index + 1] if number}
        slots.append(NumberSlot(limit.low, tokens, tuple(sorted(ends))))
    grammar = AnswerGrammar(tuple(templates), tuple(slots))
    for index, slot in enumerate(slots):
        _check_unique(tokenizer, slot, index)
    _check_whole_answers(tokenizer, grammar, style)
    return grammar


def _write(tokenizer: Tokenizer, integers: np.ndarray, style: Style) -> list[int]:
    return tokenize_answer(tokenizer, ":", format_answer(integers, style))[1]


def _common_prefix(rows: Sequence[Sequence[int]]) -> int:
    shortest = min(rows, key=len)
    for place, token in enumerate(shortest):
        if any(row[place] != token for row in rows):
            return place
    return len(shortest)


def _check_unique(tokenizer: Tokenizer, slot: NumberSlot, index: int) -> None:
    """A number is over as soon as its tokens are: what may follow it never continues it to another one."""
    numbers = dict(zip(slot.tokens, slot.values, strict=True))
    if len(numbers) < len(slot.tokens) or () in numbers:
        raise _unseparable(tokenizer, f"number {index} of the answer is written alike for different values", [])
    for tokens, value in numbers.items():
        for length in range(1, len(tokens)):
            if tokens[:length] in numbers and tokens[length] in slot.ends:
                raise _unseparable(tokenizer, f"nothing tells {numbers[tokens[:length]]} from the start of {value}", [])


def _check_whole_answers(tokenizer: Tokenizer, grammar: AnswerGrammar, style: Style) -> None:
    """Whole prompts with random answers, and with all signs and lengths beside one another."""
    rng = np.random.default_rng(0)
    for trial in range(_CHECKED_ANSWERS):
        # Of every digit count equally many, so that short numbers stand beside long ones.
        largest = 10 ** rng.integers(0, 4, len(grammar.slots))
        drawn = rng.integers(-largest, largest + 1)
        limits = [(slot.values[0], slot.values[-1]) for slot in grammar.slots]
        integers = np.array([np.clip(value, *limit) for value, limit in zip(drawn, limits, strict=True)])
        integers = integers.reshape(grammar.num_arms, VALUES_PER_ARM)
        integers[:, QUATERNION_VALUES.stop - 1] += (integers[:, QUATERNION_VALUES] == 0).all(axis=1)
        keypoints = integers[:, :3] if trial % 2 else None
        answer = format_answer(integers, style)
        tokens = tokenize_answer(tokenizer, format_prompt("lift the tray", integers, keypoints, style), answer)[1]
        if [*tokens, tokenizer.eos_id] != grammar.tokens(integers):
            raise _unseparable(tokenizer, f"{answer!r} is not written as its parts are", tokens)
        try:
            parsed = parse_answer(tokenizer.decode(tokens), grammar.num_arms, style)
        except ParseFailure as error:
            raise _unseparable(tokenizer, f"an answer does not survive: {error}", tokens) from error
        if (parsed != integers).any():
            raise _unseparable(tokenizer, f"{answer!r} reads back as {tokenizer.decode(tokens)!r}", tokens)


def _unseparable(tokenizer: Tokenizer, reason: str, tokens: Sequence[int]) -> UserError:
    shown = f" (its tokens: {' | '.join(tokenizer.decode([token]) for token in tokens[:40])})" if tokens else ""
    return UserError(
        f"tokenizer: {reason}{shown}; the numbers of an answer could not be masked one by one. Use another tokenizer, "
        "or the other prompt style"
    )
