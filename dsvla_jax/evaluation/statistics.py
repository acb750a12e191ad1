"""How sure a success rate is."""

import math
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
