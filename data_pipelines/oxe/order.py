"""The order of samples as pure functions of their number: no buffer to shuffle in, and any position can be resumed.

Episodes are put in a new random order each epoch; each `window` consecutive ones form a block, whose frames are drawn
in random order. Which dataset a number belongs to is a schedule that repeats, in which each has its share to one slot.
"""

import bisect
from typing import TypeVar

import numpy as np

Key = TypeVar("Key")
Value = TypeVar("Value")


def schedule(shares: np.ndarray, seed: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """(dataset, occurrence), int32 (M,) each: whose turn it is, and how many turns it has had before.

    shares: (D,), adding up to 1. A dataset's turns are spread evenly with one random place in each of its intervals, so
    that any stretch of numbers holds its share to within two turns.
    """
    length = int(np.clip(np.ceil(500 / shares.min()), 1 << 12, 1 << 21))
    turns = np.floor(shares * length).astype(int)
    short = length - turns.sum()
    turns[np.argsort(turns - shares * length)[:short]] += 1
    turns = np.maximum(turns, 1)
    rng = np.random.default_rng(seed)
    place = np.concatenate([(np.arange(n) + rng.random(n)) / n for n in turns])
    dataset = np.repeat(np.arange(len(shares)), turns)[np.argsort(place, kind="stable")].astype(np.int32)
    occurrence = np.empty(len(dataset), np.int32)
    for number in range(len(shares)):
        mine = np.flatnonzero(dataset == number)
        occurrence[mine] = np.arange(len(mine))
    return dataset, occurrence


def deal(episodes: int, streams: int, seed: list[int]) -> list[np.ndarray]:
    """Episode numbers of each stream: all episodes in random order, dealt out in turns."""
    order = np.random.default_rng(seed).permutation(episodes)
    return [order[stream::streams] for stream in range(streams)]


class BlockOrder:
    """The order of one stream's samples of one dataset.

    samples: int (E,), of each episode. window: episodes a block. keep: how many blocks' orders are remembered.
    """

    def __init__(self, samples: np.ndarray, window: int, seed: list[int], keep: int = 2) -> None:
        self._samples, self._window, self._seed, self._keep = samples, window, seed, keep
        self.num_samples = int(samples.sum())
        self._epochs: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._blocks: dict[tuple[int, int], np.ndarray] = {}

    def locate(self, number: int) -> tuple[tuple[int, int], int, int]:
        """((epoch, block), episode, sample within the episode) of the stream's sample of that number."""
        epoch, place = divmod(number, self.num_samples)
        order, starts = self._epoch(epoch)
        block = bisect.bisect_right(starts, place) - 1
        episodes = order[block * self._window : (block + 1) * self._window]
        ends = np.cumsum(self._samples[episodes])
        flat = int(self._shuffled(epoch, block, int(ends[-1]))[place - int(starts[block])])
        within = int(np.searchsorted(ends, flat, side="right"))
        return (epoch, block), int(episodes[within]), flat - int(ends[within] - self._samples[episodes[within]])

    def _epoch(self, epoch: int) -> tuple[np.ndarray, np.ndarray]:
        """The episodes in the order of an epoch, and the first sample of each block."""
        if epoch not in self._epochs:
            order = np.random.default_rng([*self._seed, epoch]).permutation(len(self._samples))
            ends = np.concatenate([[0], np.cumsum(self._samples[order])])
            self._epochs[epoch] = order, ends[:-1][:: self._window]
        return recent(self._epochs, epoch, self._keep)

    def _shuffled(self, epoch: int, block: int, size: int) -> np.ndarray:
        if (epoch, block) not in self._blocks:
            order = np.random.default_rng([*self._seed, epoch, block, 1]).permutation(size)
            self._blocks[epoch, block] = order
        return recent(self._blocks, (epoch, block), self._keep)


def recent(table: dict[Key, Value], key: Key, keep: int) -> Value:
    """The entry of `key`, all but the `keep` entries that were last asked for being dropped."""
    value = table[key] = table.pop(key)
    while len(table) > keep:
        del table[next(iter(table))]
    return value
