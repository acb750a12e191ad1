"""What a run's demonstrations are like, which its policy keeps: see `dsvla_jax.data_config.LearnedFrom`."""

from collections.abc import Sequence
from pathlib import Path

from data_pipelines.episodes import EpisodeReader
from data_pipelines.records import picture_size
from data_pipelines.sources import choose_tasks
from dsvla_jax.data_config import DataConfig, LearnedFrom, OxeConfig


def learned_from(data: DataConfig, use_keypoints: bool) -> LearnedFrom:
    """That of demonstrations that are on disk. use_keypoints: whether the policy's prompts state them."""
    tasks = choose_tasks(data)
    reader = EpisodeReader(Path(data.folder), tasks=tasks, episodes=data.episodes, fewer=True, cameras=data.cameras)
    first = reader.episode(0)
    simulated = data.source == "simulator"
    known = simulated or _first_keypoints(data, tasks)
    return LearnedFrom(
        source="simulator" if simulated else "demonstrations",
        keypoints="none" if not (use_keypoints and known) else data.keypoints if simulated else "recorded",
        image_size=picture_size(first.rgb_png[0]),
        arms=tuple(sorted(set(reader.num_arms.values()))),
        tasks=tasks,
        cameras=reader.cameras,
    )


def learned_from_oxe(oxe: OxeConfig, arms: Sequence[int]) -> LearnedFrom:
    """That of a mixture. arms: the number of each of its datasets."""
    return LearnedFrom(
        source="oxe",
        keypoints="none",
        image_size=(oxe.image_size, oxe.image_size),
        arms=tuple(sorted(set(arms))),
        tasks=oxe.mixture,
    )


def _first_keypoints(data: DataConfig, tasks: Sequence[str]) -> bool:
    """Whether the first demonstration of any task has keypoints."""
    readers = (EpisodeReader(Path(data.folder), tasks=(task,), episodes=1) for task in tasks)
    return any(reader.episode(0).keypoints.size > 0 for reader in readers)
