"""Seconds of a program on a device: the first call, which compiles, apart from the later ones."""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from typing import TypeVar

import jax

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Timing:
    """Wall seconds of the first call and of each later one."""

    first: float
    later: tuple[float, ...]

    @property
    def median(self) -> float:
        """Of the later calls."""
        return statistics.median(self.later)

    def figures(self) -> dict[str, float]:
        """What a report says of it; the first call less a later one counts as compiling."""
        return {
            "compile_seconds": self.first - self.median,
            "seconds": self.median,
            "fastest": min(self.later),
            "slowest": max(self.later),
            "repeats": len(self.later),
        }


def call(what: Callable[[], T]) -> tuple[T, float]:
    """The result, and the seconds until it is there."""
    began = time.perf_counter()
    result = jax.block_until_ready(what())
    return result, time.perf_counter() - began


def timed(what: Callable[[], T], repeats: int, seconds: float = math.inf) -> tuple[T, Timing]:
    """The last result of calling ``what`` once and then ``repeats`` times, and how long each call took.

    seconds: the later calls end early when they have taken so long together; there is at least one.
    """
    result, first = call(what)
    later: list[float] = []
    while not later or (len(later) < repeats and sum(later) < seconds):
        result, took = call(what)
        later.append(took)
    return result, Timing(first, tuple(later))
