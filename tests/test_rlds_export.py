"""Demonstrations as RLDS builds: what is read back from them is what was recorded."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.episodes import EpisodeReader, write_episodes
from data_pipelines.oxe.mixture import MixtureSource
from data_pipelines.records import Episode, decode_rgb
from data_pipelines.rlds.export import Options, main
from data_pipelines.rlds.features import decode_image
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.displacement import displace
from dsvla_jax.errors import UserError
from tests.random_data import random_episode


def with_unit_quaternions(episode: Episode) -> Episode:
    def normalised(poses: np.ndarray) -> np.ndarray:
        rotation = poses[..., 3:] / np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
        return np.concatenate([poses[..., :3], rotation], axis=-1)

    return dataclasses.replace(episode, pose=normalised(episode.pose), target_pose=normalised(episode.target_pose))


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    made = [random_episode(seed, frames=2 + seed, size=16) for seed in range(3)]
    made += [random_episode(seed, "bimanual_lift_ball", arms=2, size=16) for seed in (3, 4)]
    write_episodes(tmp_path / "demos", map(with_unit_quaternions, made))
    main(Options(tmp_path / "demos", tmp_path / "rlds", shards=2))
    return tmp_path


def same_rotation(one: np.ndarray, other: np.ndarray) -> None:
    np.testing.assert_allclose(np.abs(np.sum(one * other, axis=-1)), 1, atol=1e-6)


@pytest.mark.parametrize("target", ["absolute", "relative"])
def test_every_recorded_frame_is_a_sample_with_its_own_target(exported: Path, target):
    """Whatever the horizon: a step's action is the next keyframe."""
    reader = EpisodeReader(exported / "demos")
    recorded = [reader.episode(number) for number in range(len(reader))]
    names = ("keyframes_one_arm", "keyframes_two_arms")
    config = OxeConfig(folder=str(exported / "rlds"), mixture=names, target=target, horizon=5.0, streams=1)
    source = MixtureSource(config, seed=0)
    found = 0
    for dataset in source.datasets:
        for number in range(dataset.num_episodes):
            samples = dataset.read(number)
            (episode,) = [one for one in recorded if one.instruction == samples[0].instruction]
            assert len(samples) == episode.num_frames
            for frame, sample in enumerate(samples):
                rgb = decode_image(sample.picture, sample.format, sample.where)
                np.testing.assert_array_equal(rgb, decode_rgb(episode.rgb_png[frame]))
                np.testing.assert_allclose(sample.pose[:, :3], episode.pose[frame, :, :3])
                same_rotation(sample.pose[:, 3:], episode.pose[frame, :, 3:])
                reached = sample.target_pose
                if reached is None:
                    assert sample.displacement is not None
                    reached = displace(sample.pose, sample.displacement)
                np.testing.assert_allclose(reached[:, :3], episode.target_pose[frame, :, :3], atol=1e-5)
                same_rotation(reached[:, 3:], episode.target_pose[frame, :, 3:])
                np.testing.assert_array_equal(sample.gripper_open, episode.gripper_open[frame])
                np.testing.assert_array_equal(sample.target_gripper, episode.target_gripper[frame])
            found += 1
    assert found == len(recorded) == 5


def test_a_build_is_not_written_over(exported: Path):
    with pytest.raises(UserError, match="keyframes_one_arm: there is a build already; delete it, or choose another"):
        main(Options(exported / "demos", exported / "rlds"))
