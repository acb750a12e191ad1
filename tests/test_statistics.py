"""How sure a success rate is, and the difference of two."""

import numpy as np
import pytest

from dsvla_jax.evaluation.statistics import Pairs, adjusted, count_pairs, paired_interval, sign_test


def test_paired_intervals_are_newcombes():
    """Values of his method 10, computed with SciPy from the formulas of his paper."""
    for counts, expected in (((36, 12, 2, 0), (0.056930, 0.340428)), ((73, 12, 5, 10), (-0.013065, 0.154497))):
        np.testing.assert_allclose(paired_interval(Pairs(*counts)), expected, atol=1e-6)
    assert paired_interval(Pairs(0, 0, 0, 0)) == (-1, 1)
    low, high = paired_interval(Pairs(50, 0, 0, 0))
    assert low < 0 < high


def test_the_sign_test_counts_discordant_pairs_alone():
    for (first, second), expected in (
        ((12, 5), 0.143463134765625),
        ((9, 1), 0.021484375),
        ((8, 1), 0.0390625),
        ((10, 0), 0.001953125),
        ((0, 0), 1.0),
    ):
        assert sign_test(Pairs(3, first, second, 7)) == pytest.approx(expected)
    assert sign_test(Pairs(0, 5, 12, 0)) == sign_test(Pairs(0, 12, 5, 0))


def test_holms_adjustment():
    np.testing.assert_allclose(adjusted([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert adjusted([]) == []


def test_pairs_are_of_the_same_episodes():
    pairs = count_pairs([True, True, False, False, True], [True, False, True, False, False])
    assert pairs == Pairs(1, 2, 1, 1)
    assert pairs.difference == pytest.approx(0.2)
    with pytest.raises(ValueError, match="shorter"):
        count_pairs([True, False], [True])
