"""The range of every number of a config or program, checked in one way.

def __post_init__(self) -> None:
    check_fields(self, "data", episodes=at_least(1), crop=more_than(0, at_most=1))
"""

import dataclasses
import functools
import math
import types
import typing
from numbers import Integral, Real
from typing import Literal

from dsvla_jax.errors import UserError

LARGEST_COUNT = 2**31 - 1
"""The largest whole number that an option takes: arrays count in int32."""

LARGEST_NUMBER = 3e38
"""The largest finite number that an option takes: arrays are float32."""


@dataclasses.dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`. `above`, `below`: without the end itself. NaN is never inside.

    A bound that is infinite is not inside either, unless `infinite`.
    """

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    below: bool = False
    infinite: bool = False

    def __contains__(self, value: float) -> bool:
        if not self.low <= value <= self.high or (math.isinf(value) and not self.infinite):
            return False
        return not ((self.above and value == self.low) or (self.below and value == self.high))

    def __str__(self) -> str:
        parts = []
        if math.isfinite(self.low):
            parts.append(f"{'more than' if self.above else 'at least'} {self.low}")
        if math.isfinite(self.high):
            parts.append(f"{'less than' if self.below else 'at most'} {self.high}")
        return ", ".join(parts) or "a finite number"


FINITE = Range()


def at_least(low: float, at_most: float = math.inf, below: float | None = None) -> Range:
    """From `low` on, to `at_most` with it or to `below` without it."""
    return Range(low, at_most if below is None else below, below=below is not None)


def more_than(low: float, at_most: float = math.inf, infinite: bool = False) -> Range:
    """Above `low`. infinite: whether infinity is a value of its own, as a limit that is never reached."""
    return Range(low, at_most, above=True, infinite=infinite)


def require(holds: bool, field: str, expected: object, got: object, fix: str = "") -> None:
    """Raises UserError, naming the option, unless a condition holds."""
    if not holds:
        raise UserError(f"{field}: expected {expected}, got {got}{f'; {fix}' if fix else ''}")


def require_box(field: str, low: tuple[float, ...], other: str, high: tuple[float, ...]) -> None:
    """Raises UserError unless one corner of a box is below the other on each axis. field, other: their options."""
    below = len(low) == len(high) and all(a < b for a, b in zip(low, high, strict=True))
    require(below, field, f"less than {other} {high} on each axis", low)


def check_fields(config: object, section: str, **ranges: Range) -> None:
    """Raises UserError if a field of a dataclass is out of its range, or no choice of its Literal type.

    section: what stands before the field's name on the command line ("data"), empty for nothing. ranges: by field, one
    for each field that holds numbers; those of a tuple must all be in it, None is no number. Whole numbers are at most
    `LARGEST_COUNT`, finite ones at most `LARGEST_NUMBER`.
    """
    kinds = _kinds(type(config))
    numeric = {name for name, kind in kinds.items() if kind.number}
    assert numeric == ranges.keys(), f"{type(config).__name__}: ranges of {numeric ^ ranges.keys()}"
    prefix = f"{section}." if section else ""
    for name, kind in kinds.items():
        value, option = getattr(config, name), prefix + name
        if kind.choices and not kind.number:
            require(value in kind.choices, option, f"one of {', '.join(map(str, kind.choices))}", repr(value))
        if kind.number and value not in kind.choices:
            numbers = value if isinstance(value, tuple) else () if value is None else (value,)
            require(kind.count in (None, len(numbers)), option, f"{kind.count} numbers", value)
            for number in numbers:
                _check_number(option, number, kind.number, ranges[name], value)


@dataclasses.dataclass(frozen=True)
class _Kind:
    """What a field may hold. number: int or float, also in a tuple or beside None. count: how many, None for any.

    choices: words that it may hold, instead of or beside a number.
    """

    number: type | None = None
    count: int | None = None
    choices: tuple[object, ...] = ()


def _check_number(option: str, number: float, kind: type, allowed: Range, whole: object) -> None:
    right = Integral if kind is int else Real
    expected = "a whole number" if kind is int else "a number"
    require(isinstance(number, right) and not isinstance(number, bool), option, expected, repr(whole))
    require(number in allowed, option, allowed, whole)
    largest = LARGEST_COUNT if kind is int else LARGEST_NUMBER
    require(math.isinf(number) or abs(number) <= largest, option, f"at most {largest}", whole)


@functools.cache
def _kinds(cls: type) -> dict[str, _Kind]:
    hints = typing.get_type_hints(cls)
    return {field.name: _kind(hints[field.name]) for field in dataclasses.fields(cls)}


def _kind(hint: object) -> _Kind:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in (int, float):
        return _Kind(hint)
    if origin is Literal:
        return _Kind(choices=arguments)
    if origin in (tuple, typing.Union, types.UnionType):
        kinds = [_kind(argument) for argument in arguments]
        numbers = {kind.number for kind in kinds if kind.number}
        count = len(arguments) if origin is tuple and Ellipsis not in arguments else None
        choices = tuple(choice for kind in kinds for choice in kind.choices)
        return _Kind(numbers.pop(), count, choices) if len(numbers) == 1 else _Kind()
    return _Kind()
