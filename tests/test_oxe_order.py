"""Mixtures: the order of samples, shares, processes, threads, and going on from a position."""

import json
import math
import os
from typing import Any

import jax
import numpy as np
import pytest

from data_pipelines.oxe.fixtures.write import known_episodes
from data_pipelines.oxe.mixture import MixtureSource, OpenDataset
from data_pipelines.oxe.order import BlockOrder, deal, schedule
from dsvla_jax.errors import DataError
from tests.oxe_mixtures import FIVE, config_for, make, names_of, write_datasets


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_datasets(tmp_path_factory.mktemp("oxe"))


def test_an_epoch_of_a_stream_is_every_sample_once():
    samples = np.array([3, 1, 7, 2, 5, 4])
    order = BlockOrder(samples, 2, [0])
    total = int(samples.sum())
    epochs = [[order.locate(epoch * total + i)[1:] for i in range(total)] for epoch in range(3)]
    everything = [(episode, place) for episode, count in enumerate(samples) for place in range(count)]
    assert all(sorted(epoch) == everything for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    # Never are more than two episodes open, and another order object finds any number by itself.
    for start in range(total - 1):
        blocks = {order.locate(i)[0] for i in (start, start + 1)}
        assert len(blocks) <= 2
    assert [BlockOrder(samples, 2, [0]).locate(i)[1:] for i in (40, 3, 17)] == [
        order.locate(i)[1:] for i in (40, 3, 17)
    ]


def test_episodes_are_dealt_out_once():
    dealt = deal(23, 4, [1])
    assert sorted(np.concatenate(dealt).tolist()) == list(range(23))


@pytest.mark.parametrize("shares", [[1.0], [0.5, 0.5], [0.001, 0.3, 0.699], [0.05] * 20])
def test_turns_follow_the_shares_everywhere(shares):
    shares = np.array(shares)
    dataset, occurrence = schedule(shares, [0])
    for number, share in enumerate(shares):
        turns = dataset == number
        assert turns.mean() == pytest.approx(share, rel=0.01)
        np.testing.assert_array_equal(occurrence[turns], np.arange(turns.sum()))
        passed = np.cumsum(turns) - np.arange(1, len(turns) + 1) * share
        assert np.abs(passed).max() <= 2


def test_an_epoch_of_one_dataset_is_every_frame_once(folder):
    name = names_of(FIVE)[0]
    source = MixtureSource(config_for(folder, (name,), streams=1), seed=3, progress=False)
    expected = sum(episode.num_steps - 1 for episode in known_episodes(name, 9, 9))
    assert source.num_samples == expected
    epochs = [[source[epoch * expected + i].where for i in range(expected)] for epoch in range(2)]
    assert len(set(epochs[0])) == len(set(epochs[1])) == expected
    assert epochs[0] != epochs[1]


def test_an_epoch_of_every_dataset_of_a_mixture_is_every_frame_once(folder):
    """Of each stream of each dataset, whichever process reads which numbers."""
    config = config_for(folder)
    sources = [MixtureSource(config, seed=3, progress=False) for _ in range(3)]
    drawn: dict[tuple[str, int], list[str]] = {}
    for number in range(3000):
        sample = sources[number % 3][number]
        drawn.setdefault((sample.dataset, number % config.streams), []).append(sample.where)
    for name in names_of(FIVE):
        everything: list[str] = []
        for stream in range(config.streams):
            told = drawn[name, stream]
            size = len(set(told))
            epochs = [told[start : start + size] for start in range(0, len(told) - size + 1, size)]
            assert len(epochs) >= 2
            assert all(sorted(epoch) == sorted(set(told)) for epoch in epochs)
            everything += set(told)
        assert len(everything) == len(set(everything))
        assert len(everything) == sum(episode.num_steps - 1 for episode in known_episodes(name, 9, 9))


def test_processes_share_out_the_one_stream(folder):
    source = MixtureSource(config_for(folder), seed=3, progress=False)
    whole = [source[i].where for i in range(90)]
    fresh = MixtureSource(config_for(folder), seed=3, progress=False)
    assert [[fresh[i].where for i in range(p, 90, 3)] for p in range(3)] == [whole[p::3] for p in range(3)]
    records = [{where.partition(", step")[0] for where in whole[p::3]} for p in range(3)]
    assert not (records[0] & records[1]) | (records[1] & records[2]) | (records[0] & records[2])


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux's /proc")
def test_no_file_stays_open(folder):
    before = len(os.listdir("/proc/self/fd"))
    loader = make(folder, threads=0)
    for _ in range(20):
        next(loader)
    assert len(os.listdir("/proc/self/fd")) <= before


def test_proportions_are_the_weights_times_the_sizes(folder):
    source = MixtureSource(config_for(folder), seed=0, progress=False)
    count = 4000
    drawn = [source[i].dataset for i in range(count)]
    weights = dict(zip(names_of(FIVE), (3, 1, 0.5, 2, 1.5), strict=True))
    sizes = {name: sum(episode.num_steps - 1 for episode in known_episodes(name, 9, 9)) for name in weights}
    total = sum(weights[name] * sizes[name] for name in weights)
    for name in weights:
        assert drawn.count(name) / count == pytest.approx(weights[name] * sizes[name] / total, rel=0.01)


@pytest.mark.parametrize("processes", [1, 3])
def test_a_stopped_run_goes_on_with_the_same_thousand_samples(folder, processes):
    for process in range(processes):
        split, batches = (process, processes), -(-1000 // (20 * processes))
        loader = make(folder, batch_size=20, split=split)
        for _ in range(7 + process):
            next(loader)
        state = json.loads(json.dumps(loader.get_state()))
        resumed = make(folder, batch_size=20, split=split, threads=0)
        resumed.set_state(state)
        for _ in range(batches):
            expected, got = next(loader), next(resumed)
            jax.tree.map(np.testing.assert_array_equal, got, expected)


def test_threads_do_not_take_each_others_blocks_away(folder, monkeypatch):
    read, asked = OpenDataset.read, []
    monkeypatch.setattr(OpenDataset, "read", lambda self, episode: asked.append(episode) or read(self, episode))
    loader = make(folder, ("cmu_stretch",), batch_size=48, threads=4, window=3)
    for _ in range(12):
        next(loader)
    # An epoch is 9 episodes of 8 samples, and up to 8 batches are made ahead.
    assert len(asked) <= 9 * math.ceil((12 + 8) * 48 / 72) + 9


def test_a_position_of_other_data_is_refused(folder):
    state = make(folder).get_state()
    with pytest.raises(DataError, match=r"saved position: data: expected .*; put the same data back"):
        make(folder, FIVE[:4]).set_state(state)
    scale: Any = state["scale"]
    assert set(scale) == {"low", "high"}
    with pytest.raises(DataError, match=r"saved position: scale: expected .*; put the same data back"):
        make(folder, horizon=0.3).set_state(state)
