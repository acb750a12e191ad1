"""The range that displacements are binned over: one for a whole mixture, so that a policy needs no dataset's name."""

from collections.abc import Sequence

import numpy as np

from data_pipelines.oxe.index import HIGH, LOW, QUANTILES
from data_pipelines.oxe.mixture import OpenDataset
from dsvla_jax.encoding.displacement import DisplacementScale, is_constant


class MixtureScale:
    """From each dataset's own displacements to the mixture's.

    The mixture's range is the 1 % to 99 % quantile over its metric datasets, each counting as much as its share of
    samples. Displacements that are not metric are stretched from their own 1 % to 99 % range to that; where no dataset
    is metric, the range is -1 to 1.
    """

    def __init__(self, datasets: Sequence[OpenDataset], shares: np.ndarray) -> None:
        """shares: (D,), of each dataset in the samples."""
        quantiles = [np.asarray(item.index.quantiles) for item in datasets]
        metric = [item.dataset.metric for item in datasets]
        low, high = -np.ones(6), np.ones(6)
        if any(metric):
            known = [(rows, share) for rows, share, one in zip(quantiles, shares, metric, strict=True) if one]
            low, high = (np.array([_quantile(known, column, at) for column in range(6)]) for at in (0.01, 0.99))
        self.scale = DisplacementScale(tuple(map(float, low)), tuple(map(float, high)))
        self._own = {
            item.dataset.name: None if one else (rows[LOW], rows[HIGH])
            for item, rows, one in zip(datasets, quantiles, metric, strict=True)
        }

    def to_mixture(self, dataset: str, displacement: np.ndarray) -> np.ndarray:
        """(A, 6) of a dataset -> (A, 6) in the mixture's range."""
        own = self._own[dataset]
        if own is None:
            return displacement
        low, high = np.array(self.scale.low), np.array(self.scale.high)
        still = is_constant(*own)
        span = np.where(still, 1.0, own[1] - own[0])
        fraction = np.where(still, 0.5, (displacement - own[0]) / span)
        return low + fraction * (high - low)


def _quantile(known: list[tuple[np.ndarray, float]], column: int, at: float) -> float:
    """Of the distribution that mixes those given by quantiles (101, 6), each with its share."""
    points = np.unique(np.concatenate([rows[:, column] for rows, _ in known]))
    levels = np.linspace(0, 1, QUANTILES)
    # Where many values are the same, the distribution jumps: what lies below and what has been passed differ.
    below = sum(share * (1 - np.interp(-points, -rows[::-1, column], levels)) for rows, share in known)
    passed = sum(share * np.interp(points, rows[:, column], levels) for rows, share in known)
    jumps = np.stack([below, passed], axis=1).ravel() / sum(share for _, share in known)
    return float(np.interp(at, jumps, np.repeat(points, 2)))
