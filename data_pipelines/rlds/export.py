"""Export demonstrations as RLDS builds: python -m data_pipelines.rlds.export data/demos OUT

Writes single-arm episodes to OUT/keyframes_one_arm and dual-arm episodes to OUT/keyframes_two_arms: the pictures of one
camera, robot states and keyframes, without depth or keypoints. They are read like any Open X-Embodiment dataset
(docs/data_oxe.md).
"""

import dataclasses
import io
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


def features(numbers_per_step: int, height: int, width: int) -> tfds_features.FeaturesDict:
    """Returns the tfds features of a build.

    numbers_per_step: the length of a state and of an action, which hold for each arm its position (metres), quaternion
    (xyzw) and gripper (1 is open). height, width: of the pictures, pixels.
    """
    numbers = tfds_features.Tensor(shape=(numbers_per_step,), dtype=np.float32)
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
    """Converts one episode to the structure that `features` describes. The reward is 1 at the last step, else 0."""

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
    """The folder of demonstrations to export."""
    out: tyro.conf.Positional[Path]
    """The folder to write the builds to. An existing build is refused."""
    camera: str = FRONT
    """The camera whose pictures are exported."""
    shards: int = 4
    """Number of files per build."""

    def __post_init__(self) -> None:
        check_fields(self, "", shards=at_least(1))


def main(options: Options) -> None:
    """Write the builds. Raises UserError if one exists."""
    reader = EpisodeReader(options.folder, cameras=(options.camera,))
    for name in NAMES.values():
        if (options.out / name).exists():
            raise UserError(f"{options.out / name}: there is a build already; delete it, or choose another folder")

    by_arms: dict[int, list[Episode]] = {arms: [] for arms in NAMES}
    for number in tqdm(range(len(reader)), desc="reading", unit="episode"):
        episode = reader.episode(number)
        by_arms[episode.num_arms].append(episode)
    for arms, episodes in by_arms.items():
        if episodes:
            height, width = decode_rgb(episodes[0].rgb_png[0]).shape[:2]
            described = features((episodes[0].pose.shape[-1] + 1) * arms, height, width)
            written = {"train": list(map(rlds_episode, episodes))}
            build = write_build(options.out, NAMES[arms], described, written, min(options.shards, len(episodes)))
            print(f"{build}: {len(episodes)} episodes")


if __name__ == "__main__":
    with fail_with_message():
        main(parse_options(Options, prog="python -m data_pipelines.rlds.export", description=__doc__))
