"""What a policy learns at each token of a number: which tokens lead to nearby bins, whatever the tokenizer.

Where an integer is one token, the tokens of its neighbours are nearly right, too. Where it is several, the same holds
at each of them for the bins that are still possible after the tokens before it: the target is 141, its tokens so far
"1", "4", and "0" and "2" lead to bins one away.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from dsvla_jax.encoding.grammar import AnswerGrammar, NumberSlot, build_answer_grammar
from dsvla_jax.encoding.prompts import Style
from dsvla_jax.encoding.text import Tokenizer

# Above so many possible values a slot is a bin. A gripper status is 0 or 1, and has no neighbour that is nearly right.
_STATUS_VALUES = 2

# A choice between tokens on the way to a target: for each token the values that it leads to, the target, and whether
# it is the number's first choice.
_Choice = tuple[tuple[tuple[int, tuple[int, ...]], ...], int, bool]


@dataclasses.dataclass(frozen=True)
class NumberTargets:
    """The choices between tokens that an answer's bins consist of, R in all, row 0 standing for no such choice.

    tokens: int32 (U,), every token that some choice offers.
    offsets: float32 (R, U), the bins from a row's target to the nearest bin that each token leads to; infinite for a
        token that the choice does not offer.
    weights: float32 (R, U), the distribution to learn; None where it is one-hot.
    begins: bool (R,), True for the first choice of a number.
    """

    tokens: np.ndarray
    offsets: np.ndarray
    weights: np.ndarray | None
    begins: np.ndarray


class NumberRows:
    """The rows of `NumberTargets` in the answers of one and two arms."""

    def __init__(self, tokenizer: Tokenizer, style: Style) -> None:
        self._grammars = {arms: build_answer_grammar(tokenizer, arms, style) for arms in (1, 2)}
        self._numbers: dict[_Choice, int] = {}
        self._rows = {arms: [self._slot_rows(s) for s in grammar.slots] for arms, grammar in self._grammars.items()}

    def rows(self, integers: np.ndarray) -> np.ndarray:
        """Action integers (A, 8) -> int32 (L,), the row of each of the answer's tokens, its end included."""
        return self._along(integers, lambda index, place: self._rows[len(integers)][index][place])

    def numbers(self, integers: np.ndarray) -> np.ndarray:
        """Returns which number of an answer each of its tokens belongs to.

        integers: the answer's (A, 8). Returns int32 (L,): 1 to 8 A, and 0 for tokens between numbers.
        """
        slots = self._grammars[len(integers)].slots
        return self._along(integers, lambda index, place: [index + 1] * len(slots[index].tokens[place]))

    def _along(self, integers: np.ndarray, of_number: Callable[[int, int], list[int]]) -> np.ndarray:
        """An answer's tokens with what `of_number` has for those of each number, by its slot and its place there."""
        grammar: AnswerGrammar = self._grammars[len(integers)]
        values = [0] * len(grammar.templates[0])
        for index, (slot, value) in enumerate(zip(grammar.slots, integers.ravel(), strict=True)):
            values += of_number(index, value - slot.low)
            values += [0] * len(grammar.templates[index + 1])
        return np.array(values, np.int32)

    def targets(self, sigma: float) -> NumberTargets:
        """The rows' contents.

        The distribution to learn is a Gaussian around the target, `sigma` bins wide, over the bins that its slot
        allows and that the tokens so far leave possible; with `sigma` 0 the paper's one-hot.
        """
        tokens = sorted({token for choices, _, _ in self._numbers for token, _ in choices})
        column = {token: index for index, token in enumerate(tokens)}
        offsets = np.full((len(self._numbers) + 1, len(tokens)), np.inf, np.float32)
        weights = np.zeros_like(offsets)
        for (choices, target, _), row in self._numbers.items():
            for token, values in choices:
                away = np.array(values, np.float64) - target
                offsets[row, column[token]] = away[np.abs(away).argmin()]
                if sigma > 0:
                    weights[row, column[token]] = np.exp(-0.5 * (away / sigma) ** 2).sum()
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
        begins = np.array([False, *(begins for _, _, begins in self._numbers)])
        return NumberTargets(np.array(tokens, np.int32), offsets, weights if sigma > 0 else None, begins)

    def _slot_rows(self, slot: NumberSlot) -> list[list[int]]:
        if len(slot.tokens) <= _STATUS_VALUES:
            return [[0] * len(tokens) for tokens in slot.tokens]
        children: dict[tuple[int, ...], dict[int, list[int]]] = {}
        for value, tokens in zip(slot.values, slot.tokens, strict=True):
            for place, token in enumerate(tokens):
                children.setdefault(tokens[:place], {}).setdefault(token, []).append(value)
        choices = {path: tuple((token, tuple(v)) for token, v in sorted(c.items())) for path, c in children.items()}
        rows = []
        for value, tokens in zip(slot.values, slot.tokens, strict=True):
            row: list[int] = []
            for place in range(len(tokens)):
                offered = choices[tokens[:place]]
                key = (offered, value, not any(row))
                row.append(0 if len(offered) == 1 else self._numbers.setdefault(key, len(self._numbers) + 1))
            rows.append(row)
        return rows


@functools.cache
def number_rows(tokenizer: Tokenizer, style: Style) -> NumberRows:
    """The rows of a tokenizer's answers; made once."""
    return NumberRows(tokenizer, style)
