"""A folder of episodes as a page: features, counts, statistics, what looks wrong, and some episodes."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from data_pipelines.episodes import EpisodeReader
from data_pipelines.first_look import cloud_warnings, frames_of, say_components, say_words
from data_pipelines.inspect.drawing import draw_clouds, draw_frame, frame_cloud
from data_pipelines.inspect.page import Page, Section, Table
from data_pipelines.records import Episode, Frame, decode_frame
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import build_prompt
from dsvla_jax.encoding.point_cloud import cloud_from_depth
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.evaluation.pictures import film_strip
from dsvla_jax.geometry.rotations import rotation_distance
from dsvla_jax.types import split_cameras

UNITS = {
    "rgb": "0 to 255",
    "depth": "m, 0: no reading",
    "intrinsics": "pixels",
    "world_from_camera": "m",
    "pose": "m, xyzw",
    "gripper_open": "0 or 1",
    "keypoint": "m",
    "target_pose": "m, xyzw",
    "target_gripper": "0 or 1",
}
# Metres and radians: a sample that asks for less than this, and for no change of a gripper, teaches to stand still.
IDLE_MOVE, IDLE_TURN = 0.01, np.deg2rad(3)
# Metres: farther than this from everything seen, keypoints are on nothing.
FAR_KEYPOINT = 0.1


def describe_episodes(folder: Path, tasks: Sequence[str] | None, shown: int, encoding: EncodingConfig) -> Page:
    """The page of a folder of episodes. shown: how many episodes of each task are drawn."""
    reader = EpisodeReader(folder, tasks=tasks)
    episodes = [reader.episode(number) for number in range(len(reader))]
    frames = frames_of(reader)
    looks = [_look(frame, encoding) for frame in frames]
    by_task = {task: [x for x in episodes if x.task == task] for task in reader.tasks}
    sections = [
        _section(episode, number, encoding)
        for group in by_task.values()
        for number, episode in enumerate(group[:shown])
    ]
    return Page(
        title=f"{folder}: {len(reader)} episodes, {reader.num_frames} samples",
        tables=[
            _features(frames[0], reader.cameras),
            _counts(by_task),
            _said(reader, episodes),
            _statistics(episodes, looks),
        ],
        warnings=[*_warnings(episodes, looks, encoding), *cloud_warnings(frames, encoding)],
        sections=sections,
    )


@dataclasses.dataclass(frozen=True)
class _Look:
    """What decoding one frame tells. keypoint_distance: metres from each keypoint to the nearest seen point."""

    missing: float
    nearest: float
    farthest: float
    in_workspace: int
    keypoint_distance: np.ndarray


def _look(frame: Frame, encoding: EncodingConfig) -> _Look:
    depth = frame.pictures.depth
    readings = depth[depth > 0]
    box = (encoding.workspace_low, encoding.workspace_high)
    clouds = [
        cloud_from_depth(one.depth, jax.tree.map(jnp.asarray, one.camera), *box, encoding.stride)
        for one in split_cameras(frame.pictures)
    ]
    points, _ = frame_cloud(frame)
    distances = [np.linalg.norm(points - point, axis=1).min() for point in frame.keypoint] if len(points) else []
    return _Look(
        missing=1 - len(readings) / depth.size,
        nearest=float(readings.min()) if len(readings) else float("nan"),
        farthest=float(readings.max()) if len(readings) else float("nan"),
        in_workspace=sum(int(np.sum(valid)) for _, valid in clouds),
        keypoint_distance=np.array(distances),
    )


def _features(frame: Frame, cameras: Sequence[str]) -> Table:
    arrays = {}
    for number, one in enumerate(split_cameras(frame.pictures)):
        of = f" of {cameras[number]}" if len(cameras) > 1 else ""
        arrays |= {
            f"rgb{of}": one.rgb,
            f"depth{of}": one.depth,
            f"intrinsics{of}": one.camera.intrinsics,
            f"world_from_camera{of}": one.camera.world_from_camera,
        }
    arrays |= {
        "pose": frame.robot.pose,
        "gripper_open": frame.robot.gripper_open,
        "keypoint": frame.keypoint,
        "target_pose": frame.target.pose,
        "target_gripper": frame.target.gripper_open,
    }
    rows = [
        (name, str(value.dtype), " x ".join(map(str, value.shape)), UNITS[name.split()[0]])
        for name, value in arrays.items()
    ]
    rows += [("instruction", "text", "", repr(frame.instruction)), ("task", "text", "", repr(frame.task))]
    return Table("features of a sample", ("feature", "type", "shape", "unit"), rows, numbers=False)


def _said(reader: EpisodeReader, episodes: list[Episode]) -> Table:
    targets = [np.concatenate([x.target_pose, x.target_gripper[..., None]], axis=-1) for x in episodes]
    rows = [("instructions", say_words(reader)), ("targets", say_components(targets))]
    return Table("what training says of them", ("", ""), rows, numbers=False)


def _counts(by_task: dict[str, list[Episode]]) -> Table:
    rows = [
        (
            task,
            str(group[0].num_arms),
            str(len(group)),
            str(sum(episode.num_frames for episode in group)),
            f"{np.mean([_keyframes(episode) for episode in group]):.1f}",
            str(len({episode.instruction for episode in group})),
            str(max(episode.keypoints.shape[1] for episode in group)),
        )
        for task, group in by_task.items()
    ]
    columns = ("task", "arms", "episodes", "samples", "keyframes", "phrases", "keypoints")
    return Table("counts", columns, rows)


def _keyframes(episode: Episode) -> int:
    targets = np.concatenate([episode.target_pose.reshape(episode.num_frames, -1), episode.target_gripper], axis=1)
    return 1 + int(np.any(targets[1:] != targets[:-1], axis=1).sum())


def _statistics(episodes: list[Episode], looks: list[_Look]) -> Table:
    targets = np.concatenate([x.target_pose[..., :3].reshape(-1, 3) for x in episodes])
    keypoints = [
        np.linalg.norm(x.active_keypoint - x.target_pose[..., :3], axis=-1) for x in episodes if x.keypoints.size
    ]
    quantities = {
        **{f"target {axis} (m)": targets[:, i] for i, axis in enumerate("xyz")},
        "way to the target (m)": np.concatenate([_moves(x).ravel() for x in episodes]),
        "turn to the target (degrees)": np.rad2deg(np.concatenate([_turns(x).ravel() for x in episodes])),
        "gripper open at the target": np.concatenate([x.target_gripper.ravel() for x in episodes]),
        "keypoint to target (m)": np.concatenate([x.ravel() for x in keypoints]) if keypoints else np.array([]),
        "keypoint to what is seen (m)": np.concatenate([x.keypoint_distance for x in looks]),
        "nearest depth (m)": np.array([x.nearest for x in looks]),
        "farthest depth (m)": np.array([x.farthest for x in looks]),
        "pixels without depth (%)": 100 * np.array([x.missing for x in looks]),
        "cloud points in the workspace": np.array([x.in_workspace for x in looks]),
    }
    rows = [
        (
            name,
            *(
                f"{number:.3g}"
                for number in (values.mean(), values.std(), values.min(), np.median(values), values.max())
            ),
        )
        for name, values in quantities.items()
        if values.size
    ]
    caption = f"statistics (depth and clouds: of {len(looks)} samples)"
    return Table(caption, ("quantity", "mean", "deviation", "least", "median", "most"), rows)


def _moves(episode: Episode) -> np.ndarray:
    return np.linalg.norm(episode.target_pose[..., :3] - episode.pose[..., :3], axis=-1)


def _turns(episode: Episode) -> np.ndarray:
    return np.asarray(rotation_distance(episode.pose[..., 3:], episode.target_pose[..., 3:]))


def _warnings(episodes: list[Episode], looks: list[_Look], encoding: EncodingConfig) -> list[str]:
    """What cannot be refused, because it may be meant, but mostly is not."""
    found = []
    low, high = np.array(encoding.codec.low), np.array(encoding.codec.high)
    targets = np.concatenate([x.target_pose[..., :3].reshape(-1, 3) for x in episodes])
    if share := float(np.mean(np.any((targets < low) | (targets > high), axis=1))):
        found.append(
            f"{100 * share:.1f} % of the targets are outside of the box of the action text, {low.tolist()} to "
            f"{high.tolist()}, and would be learned at its surface; move the world's origin, or widen encoding.codec"
        )
    if all(
        (x.gripper_open == x.gripper_open[0]).all() and (x.target_gripper == x.gripper_open[0]).all() for x in episodes
    ):
        found.append("no gripper ever changes: is gripper_open recorded?")
    idle = np.concatenate(
        [
            ((_moves(x) < IDLE_MOVE) & (_turns(x) < IDLE_TURN) & (x.gripper_open == x.target_gripper)).all(axis=1)
            for x in episodes
        ]
    )
    if idle.mean() > 0.1:
        found.append(f"{100 * idle.mean():.0f} % of the samples ask for no motion: are the keyframes right?")
    if (missing := np.mean([look.missing for look in looks])) > 0.5:
        found.append(f"{100 * missing:.0f} % of the pixels have no depth")
    distances = np.concatenate([look.keypoint_distance for look in looks])
    if distances.size and np.median(distances) > FAR_KEYPOINT:
        found.append(
            f"half of the keypoints are {np.median(distances):.2f} m or more from everything that the camera sees: are "
            "they in the world frame, and is the camera calibrated?"
        )
    return found


def _section(episode: Episode, number: int, encoding: EncodingConfig) -> Section:
    frames = [decode_frame(episode, place) for place in range(episode.num_frames)]
    strip = film_strip([draw_frame(frame) for frame in frames])
    caption = "what is seen; rings: where to go next (magenta the left or only arm, cyan the right); crosses: keypoints"
    lines = []
    for frame in frames:
        keypoints = frame.keypoint if len(frame.keypoint) else None
        bins = np.asarray(encoding.codec.encode(frame.target.pose, frame.target.gripper_open))
        lines += [
            build_prompt(encoding, frame.instruction, frame.robot, keypoints),
            f"    {format_answer(bins, encoding.style)}",
        ]
    heading = f"{episode.task}, episode {number}: “{episode.instruction}”"
    return Section(heading, [(caption, strip), *draw_clouds(frames[0])], lines)
