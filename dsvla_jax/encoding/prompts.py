"""The sentences the policy reads and writes: one grammar for prompts, answers and their parser.

Two styles:
    paper    the sentences of 3DS-VLA in the Alpaca wrapper its language model was tuned with.
    compact  words and integers only, for policies small enough to train on a CPU.

Integers are those of ``codec.PoseCodec``. The left arm comes first. A prompt ends in ":", and the answer follows after
a space (``grammar.tokenize_answer``).
"""

import dataclasses
import functools
import re
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jax.typing import ArrayLike

from dsvla_jax.encoding.codec import QUATERNION_VALUES, VALUES_PER_ARM

Style = Literal["paper", "compact"]
STYLES: tuple[Style, ...] = ("paper", "compact")

_WRAPPER = (
    "Below is an instruction that describes a task. Write a response that appropriately completes the request.\n\n"
    "### Instruction:\n{}\n\n### Response:"
)
_QUESTION = "Determine the gripper's position, orientation, and operational state for the next step in the task: {}."


@dataclasses.dataclass(frozen=True)
class Slot:
    """A place in the answer for one integer from ``low`` to ``high``, both included."""

    low: int
    high: int


POSITION_SLOT = Slot(-100, 200)
IMAGINARY_SLOT = Slot(-100, 100)
REAL_SLOT = Slot(0, 100)  # canonical quaternions have no negative real part
GRIPPER_SLOT = Slot(0, 1)
_ARM_SLOTS = (POSITION_SLOT,) * 3 + (IMAGINARY_SLOT,) * 3 + (REAL_SLOT, GRIPPER_SLOT)


class ParseFailure(ValueError):
    """A text that is not an answer. Counts as a failed step; no pose is ever put in its place."""


def format_prompt(instruction: str, state_ints: ArrayLike, keypoint_ints: ArrayLike | None, style: Style) -> str:
    """The question for one step.

    Args:
        instruction: the task in words; a final full stop is dropped.
        state_ints: (A, 8), the arms' own poses and grippers.
        keypoint_ints: (A, 3), the active keypoint of each arm, or None to leave the keypoint constraint out.
    """
    state = _integers(state_ints, VALUES_PER_ARM, "state_ints")
    sides = _sides(len(state))
    keypoints = [] if keypoint_ints is None else _integers(keypoint_ints, 3, "keypoint_ints")
    if keypoint_ints is not None and len(keypoints) != len(state):
        raise ValueError(f"keypoint_ints: expected one row for each of {len(state)} arms, got {len(keypoints)}")
    instruction = instruction.strip().rstrip(".")
    if _check_style(style) == "compact":
        words = [instruction]
        for side, row in zip(sides, state, strict=True):
            words += [side or "state", *map(str, row)]
        if keypoints:
            words += ["near", *(str(value) for row in keypoints for value in row)]
        return " ".join(words) + ":"
    sentences = [_QUESTION.format(instruction)]
    for side, row in zip(sides, state, strict=True):
        gripper = f"The current {side} gripper".replace("  ", " ")
        sentences += [
            f"{gripper} position is {row[:3]}.",
            f"{gripper} rotation is {row[3:7]}.",
            f"{gripper} state is {row[7]}.",
        ]
    for side, row in zip(sides, keypoints, strict=False):
        sentences.append(f"The {side} target position is within or near the point: {row}.".replace("  ", " "))
    return _WRAPPER.format(" ".join(sentences))


@functools.cache
def answer_pieces(num_arms: int, style: Style) -> tuple[str | Slot, ...]:
    """The answer as fixed texts and slots, in order; joining them with integers in the slots gives the answer."""
    sides = _sides(num_arms)
    if _check_style(style) == "compact":
        slots = [slot for _ in sides for slot in _ARM_SLOTS]
        return tuple(piece for slot in slots for piece in (" ", slot))[1:]
    pieces: list[str | Slot] = []
    for index, side in enumerate(sides):
        gripper = f"The {side} gripper".replace("  ", " ")
        pieces += [
            f"{' ' if index else ''}{gripper} position is [",
            *(POSITION_SLOT, ", ", POSITION_SLOT, ", ", POSITION_SLOT),
            f"]. {gripper} rotation quaternion is [",
            *(IMAGINARY_SLOT, ", ", IMAGINARY_SLOT, ", ", IMAGINARY_SLOT, ", ", REAL_SLOT),
            f"]. {gripper} open status is ",
            GRIPPER_SLOT,
            ".",
        ]
    return tuple(pieces)


def format_answer(ints: ArrayLike, style: Style) -> str:
    """Action integers (A, 8) -> the answer text."""
    rows = _integers(ints, VALUES_PER_ARM, "action integers")
    values = [value for row in rows for value in row]
    pieces = answer_pieces(len(rows), style)
    for position, slot in enumerate(piece for piece in pieces if isinstance(piece, Slot)):
        if not slot.low <= values[position] <= slot.high:
            arm, column = divmod(position, VALUES_PER_ARM)
            raise ValueError(
                f"action integers: expected {slot.low} to {slot.high} at [{arm}, {column}], got {values[position]}; "
                "make them with PoseCodec.encode"
            )
    remaining = iter(values)
    return "".join(str(next(remaining)) if isinstance(piece, Slot) else piece for piece in pieces)


def parse_answer(text: str, num_arms: int, style: Style) -> np.ndarray:
    """The answer text -> int32 (A, 8). Spacing and letter case are free; all else must be the grammar's.

    Raises:
        ParseFailure: the text is not an answer, a number is out of its range, or a quaternion is zero.
    """
    pieces = answer_pieces(num_arms, style)
    match = re.fullmatch(_answer_pattern(pieces), text, flags=re.IGNORECASE)
    if match is None:
        raise ParseFailure(f"expected an answer of {num_arms} arm(s) in style {style!r}, got {text!r}")
    values = [int(group) for group in match.groups()]
    for value, slot in zip(values, [piece for piece in pieces if isinstance(piece, Slot)], strict=True):
        if not slot.low <= value <= slot.high:
            raise ParseFailure(f"number {value} is outside {slot.low} to {slot.high} in {text!r}")
    integers = np.array(values, np.int32).reshape(num_arms, VALUES_PER_ARM)
    if (integers[:, QUATERNION_VALUES] == 0).all(axis=1).any():
        raise ParseFailure(f"a quaternion of zeros is no rotation, in {text!r}")
    return integers


def template_texts() -> list[str]:
    """Texts that together hold every fixed word and sign of all prompts and answers."""
    texts = []
    for style in STYLES:
        for arms in (1, 2):
            state = np.tile(np.array([0, 0, 0, 0, 0, 0, 1, 0]), (arms, 1))
            texts += [format_prompt("", state, np.zeros((arms, 3), int), style), format_answer(state, style)]
    return texts


def _answer_pattern(pieces: Sequence[str | Slot]) -> str:
    atoms: list[tuple[str, bool]] = []  # a pattern, and whether it is a word or number rather than a sign
    for piece in pieces:
        if isinstance(piece, Slot):
            atoms.append((r"(-?\d{1,3})", True))
        else:
            atoms += [(re.escape(atom), atom.isalnum()) for atom in re.findall(r"\w+|[^\w\s]", piece)]
    pattern, previous_is_word = r"\s*", False
    for atom, is_word in atoms:
        pattern += (r"\s+" if is_word and previous_is_word else r"\s*") + atom
        previous_is_word = is_word
    return pattern + r"\s*"


def _sides(num_arms: int) -> tuple[str, ...]:
    if num_arms not in (1, 2):
        raise ValueError(f"expected 1 or 2 arms, got {num_arms}")
    return ("",) if num_arms == 1 else ("left", "right")


def _check_style(style: str) -> str:
    if style not in STYLES:
        raise ValueError(f"prompt style: expected one of {', '.join(STYLES)}, got {style!r}")
    return style


def _integers(values: ArrayLike, columns: int, name: str) -> list[list[int]]:
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != columns or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name}: expected integers of shape (arms, {columns}), got {array.dtype} {array.shape}")
    return array.tolist()
