"""How sure a success rate is, and how sure the difference of two."""

import dataclasses
import math
from collections.abc import Sequence
from statistics import NormalDist


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a proportion (Wilson 1927, without continuity correction).

    Unlike the normal interval it stays within [0, 1] and keeps a width when all or no trials succeed. Without trials
    nothing is known: (0, 1).
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials: expected 0 <= successes <= trials")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}: expected a number between 0 and 1, such as 0.95")
    if trials == 0:
        return 0.0, 1.0
    z2 = NormalDist().inv_cdf(0.5 + 0.5 * confidence) ** 2
    rate = successes / trials
    centre = (rate + 0.5 * z2 / trials) / (1 + z2 / trials)
    reach = math.sqrt(z2 * (rate * (1 - rate) + 0.25 * z2 / trials) / trials) / (1 + z2 / trials)
    # At the ends the interval touches 0 and 1 exactly; rounding does not.
    low = 0.0 if successes == 0 else max(0.0, centre - reach)
    high = 1.0 if successes == trials else min(1.0, centre + reach)
    return low, high


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Counts of the same episodes by which of two policies succeeded."""

    both: int
    first: int
    """The first one alone succeeded."""
    second: int
    """The second one alone succeeded."""
    neither: int

    @property
    def trials(self) -> int:
        """Episodes."""
        return self.both + self.first + self.second + self.neither

    @property
    def difference(self) -> float:
        """The first one's success rate less the second one's."""
        return (self.first - self.second) / self.trials if self.trials else 0.0


def count_pairs(first: Sequence[bool], second: Sequence[bool]) -> Pairs:
    """Counts the outcomes of the same episodes in the same order. Raises ValueError for other numbers of them."""
    outcomes = list(zip(first, second, strict=True))
    return Pairs(
        both=outcomes.count((True, True)),
        first=outcomes.count((True, False)),
        second=outcomes.count((False, True)),
        neither=outcomes.count((False, False)),
    )


def paired_interval(pairs: Pairs, confidence: float = 0.95) -> tuple[float, float]:
    """Newcombe's score interval of the difference of two rates in the same episodes.

    Method 10 of Newcombe 1998 (Stat Med 17:2635): combines Wilson's intervals of both rates and their correlation.
    Without trials the interval is (-1, 1).
    """
    a, b, c, d = pairs.both, pairs.first, pairs.second, pairs.neither
    n = pairs.trials
    if n == 0:
        return -1.0, 1.0
    one, other = (a + b) / n, (a + c) / n
    (low_one, high_one), (low_other, high_other) = (wilson_interval(x, n, confidence) for x in (a + b, a + c))
    root = math.sqrt((a + b) * (c + d) * (a + c) * (b + d))
    product = a * d - b * c
    correlation = (max(product - n / 2, 0) if product > 0 else product) / root if root else 0.0

    def reach(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * correlation * x * y + y * y, 0.0))

    difference = one - other
    low = difference - reach(one - low_one, high_other - other)
    return max(low, -1.0), min(difference + reach(high_one - one, other - low_other), 1.0)


def sign_test(pairs: Pairs) -> float:
    """McNemar's exact two-sided test (1947): the p-value of both policies being equally good in these episodes."""
    discordant, fewer = pairs.first + pairs.second, min(pairs.first, pairs.second)
    tail = sum(math.comb(discordant, k) for k in range(fewer + 1)) / 2**discordant
    return min(1.0, 2 * tail)


def adjusted(p_values: Sequence[float]) -> list[float]:
    """Holm's adjustment of p-values that are looked at together (1979, Scand J Stat 6:65), in their order."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    result, largest = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        result[i] = largest
    return result
