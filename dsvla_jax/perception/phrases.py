"""An instruction to the objects it names, in its order, as phrases for an open-vocabulary detector.

Phrases follow those with which 3DS-VLA's authors found the objects of RLBench's tasks (clorislili/3ds-vla,
Grounded-Segment-Anything/grounded_sam_demo_*.py): looks tell objects apart better than names do.
"""

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path

from dsvla_jax.errors import UserError
from dsvla_jax.json_values import Json

_COLOUR = re.compile(r"\b(?!the\b|stack\b)(\w+) (?:pepper|object|blocks?)\b")


@dataclasses.dataclass(frozen=True)
class ObjectPhrases:
    """The objects of one task.

    said: regular expression that recognises its instructions, lower case. arms: for each arm, the left one first, the
    phrases in the order of the instruction; "{colour}" is filled in with the word before the object's name.
    A phrase that ends in " (one end)" or " (other end)" stands for an end of a long object instead of its centre.
    """

    task: str
    said: str
    arms: tuple[tuple[str, ...], ...]


def phrases_for(instruction: str, table: Sequence[ObjectPhrases]) -> tuple[tuple[str, ...], ...]:
    """For each arm the phrases of the instruction's objects, in order. The first row that recognises it counts.

    Raises UserError if no row does.
    """
    words = instruction.lower().replace("_", " ")
    for row in table:
        if re.search(row.said, words):
            colour = _COLOUR.search(words)
            name = colour[1] if colour else ""
            return tuple(tuple(phrase.replace("{colour}", name).strip() for phrase in phrases) for phrases in row.arms)
    raise UserError(
        f"no object phrases for the instruction {instruction!r}; give them in a file of "
        '{"regular expression": ["phrase", ...]}, see docs/perception.md'
    )


def load_table(path: Path) -> tuple[ObjectPhrases, ...]:
    """The rows of a JSON file: {"regular expression": ["phrase", ...]}, or a list of phrases for each arm.

    Raises UserError naming the file and what is wrong with it.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return tuple(_row(said, phrases) for said, phrases in content.items())
    except (OSError, json.JSONDecodeError, AttributeError, ValueError, re.error) as error:
        raise UserError(
            f'{path}: expected a JSON object of {{"regular expression": ["phrase", ...]}} ({error})'
        ) from error


def _row(said: str, phrases: Json) -> ObjectPhrases:
    re.compile(said)
    arms = phrases if isinstance(phrases, list) and phrases and isinstance(phrases[0], list) else [phrases]
    rows: list[tuple[str, ...]] = []
    for arm in arms:
        words = [phrase for phrase in arm if isinstance(phrase, str) and phrase] if isinstance(arm, list) else []
        if not words or words != arm:
            raise ValueError(f"{said!r}: expected phrases, got {arm!r}")
        rows.append(tuple(words))
    return ObjectPhrases(said, said, tuple(rows))
