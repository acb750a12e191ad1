"""Demonstrations as RLDS builds: python -m data_pipelines.rlds.export data/demos OUT

Writes OUT/keyframes_one_arm and OUT/keyframes_two_arms, of the episodes of robots with so many arms: pictures of one
camera, states and keyframes, without depth and keypoints. They are read as any Open X-Embodiment dataset is
(docs/data_oxe.md), and by TensorFlow Datasets.
"""

import dataclasses
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tyro
from tensorflow_datasets.core import features as tfds_features
from tqdm import tqdm

from data_pipelines.episodes import EpisodeReader
from data_pipelines.records import Episode, decode_rgb
from data_pipelines.rlds.writing import write_build
from dsvla_jax.command_line import fail_with_message, parse_options
from dsvla_jax.errors import UserError
from dsvla_jax.ranges import at_least, check_fields
from dsvla_jax.sim.cameras import FRONT

NAMES = {1: "keyframes_one_arm", 2: "keyframes_two_arms"}
NUMBERS = 8
"""Of an arm, in state and action: position, quaternion xyzw, 1 for an open gripper."""


def features(arms: int, height: int, width: int) -> tfds_features.FeaturesDict:
    """What a build of robots with so many arms holds."""
    numbers = tfds_features.Tensor(shape=(NUMBERS * arms,), dtype=np.float32)
    flag, value = tfds_features.Scalar(dtype=np.bool_), tfds_features.Scalar(dtype=np.float32)
    picture = tfds_features.Image(shape=(height, width, 3), encoding_format="png")
    step = {
        "observation": tfds_features.FeaturesDict({"image": picture, "state": numbers}),
        "action": numbers,
        "language_instruction": tfds_features.Text(),
        "is_first": flag,
        "is_last": flag,
        "is_terminal": flag,
        "discount": value,
        "reward": value,
    }
    return tfds_features.FeaturesDict(
        {
            "steps": tfds_features.Dataset(tfds_features.FeaturesDict(step)),
            "episode_metadata": tfds_features.FeaturesDict({"task": tfds_features.Text()}),
        }
    )


def rlds_episode(episode: Episode) -> dict[str, object]:
    """One episode as `features` tells; the demonstrator succeeds with its last step."""

    def numbers(pose: np.ndarray, gripper_open: np.ndarray) -> np.ndarray:
        return np.concatenate([pose, gripper_open[..., None]], axis=-1).reshape(len(pose), -1).astype(np.float32)

    states = numbers(episode.pose, episode.gripper_open)
    actions = numbers(episode.target_pose, episode.target_gripper)
    last = episode.num_frames - 1
    steps = [
        {
            "observation": {"image": io.BytesIO(episode.rgb_png[number]), "state": states[number]},
            "action": actions[number],
            "language_instruction": episode.instruction,
            "is_first": number == 0,
            "is_last": number == last,
            "is_terminal": number == last,
            "discount": 1.0,
            "reward": float(number == last),
        }
        for number in range(episode.num_frames)
    ]
    return {"steps": steps, "episode_metadata": {"task": episode.task}}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command line."""

    folder: tyro.conf.Positional[Path]
    """The demonstrations."""
    out: tyro.conf.Positional[Path]
    """The folder of the builds; a build that is there already is refused."""
    camera: str = FRONT
    """The camera whose pictures are written."""
    shards: int = 4
    """Files of each build."""

    def __post_init__(self) -> None:
        check_fields(self, "", shards=at_least(1))


def main(options: Options) -> None:
    """Writes the builds."""
    reader = EpisodeReader(options.folder, cameras=(options.camera,))
    for name in NAMES.values():
        if (options.out / name).exists():
            raise UserError(f"{options.out / name}: there is a build already; delete it, or choose another folder")

    def episodes(arms: int) -> Iterator[Episode]:
        for number in tqdm(range(len(reader)), desc=NAMES[arms], unit="episode"):
            episode = reader.episode(number)
            if episode.num_arms == arms:
                yield episode

    for arms, name in NAMES.items():
        chosen = list(episodes(arms))
        if chosen:
            height, width = decode_rgb(chosen[0].rgb_png[0]).shape[:2]
            shards = min(options.shards, len(chosen))
            written = [rlds_episode(episode) for episode in chosen]
            build = write_build(options.out, name, features(arms, height, width), {"train": written}, shards)
            print(f"{build}: {len(chosen)} episodes")


if __name__ == "__main__":
    with fail_with_message():
        main(parse_options(Options, prog="python -m data_pipelines.rlds.export", description=__doc__))
