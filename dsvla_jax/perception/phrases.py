"""An instruction to the objects it names, in its order, as phrases for an open-vocabulary detector.

Phrases follow those with which 3DS-VLA's authors found the objects of RLBench's tasks (clorislili/3ds-vla,
Grounded-Segment-Anything/grounded_sam_demo_*.py): looks tell objects apart better than names do.
"""

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dsvla_jax.errors import UserError

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


def _one(task: str, said: str, *phrases: str) -> ObjectPhrases:
    return ObjectPhrases(task, said, (phrases,))


def _both(task: str, said: str, *phrases: str) -> ObjectPhrases:
    return ObjectPhrases(task, said, (phrases, phrases))


# The first row that recognises an instruction counts.
TABLE = (
    _both("bimanual_lift_tray", r"\b(lift|raise|pick up|take) (the )?tray\b", "tray"),
    _both("bimanual_lift_ball", r"\bball\b", "ball"),
    _both("bimanual_pick_laptop", r"\b(pick up|pick|push|lift|slide) (the )?laptop\b|\bnotebook\b", "laptop"),
    _both("bimanual_push_box", r"\b(push|slide) (the )?(heavy )?box\b|push the box", "box", "red square"),
    ObjectPhrases(
        "bimanual_straighten_rope",
        r"\brope\b",
        (("red rope (one end)", "green block"), ("red rope (other end)", "green block")),
    ),
    _one("put_knife_on_chopping_board", r"\bknife\b", "knife", "small chopping board on table"),
    _one("stack_blocks", r"\bblocks?\b", "{colour} block", "light green"),
    _one("take_off_weighing_scales", r"\bpepper\b|\bscales\b|off the tray", "{colour} pepper"),
    _one("take_usb_out_of_computer", r"\busb\b", "small usb"),
    _one("beat_the_buzz", r"\bbuzz\b|\bwand\b|\bring\b", "orange handle"),
    _one("change_clock", r"\bclock\b", "wooden button"),
    _one("close_box", r"\bbox\b", "box with two parts"),
    _one("close_fridge", r"\bfridge\b", "fridge"),
    _one("close_laptop_lid", r"\blaptop\b", "laptop"),
    _one("lamp_on", r"\blamp\b|\blight\b", "little green light switch"),
    _one("open_microwave", r"\bmicrowave\b", "small handle on microwave"),
    _one("phone_on_base", r"phone\b|\bhandset\b", "grey phone near the red base on the desk", "red phone base"),
    _one("place_wine_at_rack_location", r"\bwine\b|\bbottle\b", "wine", "rack"),
    _one("press_switch", r"\bswitch\b", "switch button"),
    _one("put_rubbish_in_bin", r"\b(rubbish|trash|white paper)\b", "small white rubbish", "black bin"),
    _one(
        "sweep_to_dustpan",
        r"\b(sweep|dust|dirt|dustpan|broom)\b",
        "the dark brown long pole with two parts",
        "bigger dark dustpan",
    ),
    _one("take_frame_off_hanger", r"\b(frame|picture)\b", "frame"),
    _one("take_umbrella_out_of_umbrella_stand", r"\bumbrella\b", "umbrella handle"),
    _one("toilet_seat_down", r"\btoilet\b", "toilet seat with two parts"),
    _one("unplug_charger", r"\bcharger\b|\bplug\b", "the smallest black charger on vertical board"),
    _one("water_plants", r"\bplants?\b|\bwatering\b", "watering can", "green plant"),
)


def phrases_for(instruction: str, table: Sequence[ObjectPhrases] = TABLE) -> tuple[tuple[str, ...], ...]:
    """For each arm the phrases of the instruction's objects, in order. Raises UserError where no row recognises it."""
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
    """Rows of a JSON file, which come before `TABLE`: {"regular expression": ["phrase", ...]}, or a list for each arm.

    Raises UserError naming the file and what is wrong with it.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = [_row(said, phrases) for said, phrases in content.items()]
    except (OSError, json.JSONDecodeError, AttributeError, ValueError, re.error) as error:
        raise UserError(
            f'{path}: expected a JSON object of {{"regular expression": ["phrase", ...]}} ({error})'
        ) from error
    return (*rows, *TABLE)


def _row(said: str, phrases: Any) -> ObjectPhrases:
    re.compile(said)
    arms: list[Any] = phrases if isinstance(phrases, list) and phrases and isinstance(phrases[0], list) else [phrases]
    for arm in arms:
        if not isinstance(arm, list) or not arm or not all(isinstance(phrase, str) and phrase for phrase in arm):
            raise ValueError(f"{said!r}: expected phrases, got {arm!r}")
    return ObjectPhrases(said, said, tuple(tuple(arm) for arm in arms))
