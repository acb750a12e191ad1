"""What is said of each source before training on it: words, components that vary, points in the workspace."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.episodes import EpisodeReader
from data_pipelines.records import Frame
from data_pipelines.sources import open_demonstrations
from data_pipelines.workspace import PointCount, View, count_points, fit_box, require_points
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import is_constant
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.observation_checks import check_camera, check_pictures, has_words
from dsvla_jax.types import split_cameras

if TYPE_CHECKING:
    from data_pipelines.oxe.mixture import OpenDataset

LOOKED_AT = 64
"""Samples of a folder, at least two of each task, or of a dataset, that are looked at."""
EPISODES = 8
"""Episodes of a dataset that they are of."""
TARGET = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")


def look_at_demonstrations(reader: EpisodeReader, encoding: EncodingConfig) -> str:
    """One line about a folder. Raises UserError where a task's pictures or camera are none, or its cloud is empty."""
    frames = frames_of(reader)
    targets = [np.concatenate([x.target.pose, x.target.gripper_open[:, None]], axis=1) for x in frames]
    said = [say_words(reader), say_components(targets)]
    if encoding.use_points:
        _require_each_camera(reader, frames, encoding)
        counts = [require_points(f"{reader.folder}, {task}", views, encoding) for task, views in views_of(frames)]
        said.append(say_points(counts, len(frames[0].pictures.rgb)))
    return f"{reader.folder}: {'; '.join(said)}"


def look_at_mixture(datasets: Sequence["OpenDataset"], encoding: EncodingConfig) -> list[str]:
    """One line a dataset. Raises UserError where what it sees in 3D is not in the workspace."""
    from data_pipelines.oxe.mixture import describe_dataset

    lines = []
    for opened in datasets:
        line = describe_dataset(opened)
        if encoding.use_points and opened.dataset.depth is not None:
            line += f"; {say_points([require_points(opened.build.folder, dataset_views(opened), encoding)])}"
        lines.append(line)
    return lines


def fit_workspace(
    data: DataConfig, oxe: OxeConfig | None, encoding: EncodingConfig, tokenizer: Tokenizer
) -> EncodingConfig:
    """The encoding with the workspace that holds what the hands of a run's data work on.

    Raises UserError where no box does, or several datasets, each with a world frame of its own, have 3D input.
    """
    if oxe is None:
        reader = open_demonstrations(data, tokenizer)
        where, views = str(reader.folder), [view for _, some in views_of(frames_of(reader)) for view in some]
    else:
        # Its feature definitions take a second to import, which no other run needs.
        from data_pipelines.oxe.mixture import open_mixture

        deep = [opened for opened in open_mixture(oxe)[0] if opened.dataset.depth is not None]
        where = ", ".join(opened.dataset.name for opened in deep) or "mixture"
        if len(deep) != 1:
            raise UserError(
                f"fit_workspace: {where}: expected one dataset with calibrated depth, got {len(deep)}; each has a world"
                " frame of its own: train on one, or give the box of all (--encoding.workspace-low, -high)"
            )
        views = dataset_views(deep[0])
    box = fit_box(views)
    if box is None:
        require_points(where, views, encoding)
        raise UserError(f"{where}: fit_workspace: too few readings are around the hands; give the box instead")
    return dataclasses.replace(encoding, workspace_low=box[0], workspace_high=box[1])


def frames_of(reader: EpisodeReader) -> list[Frame]:
    """Evenly spaced frames of every task, decoded."""
    share = max(2, LOOKED_AT // len(reader.tasks))
    return [
        reader.frame(int(number))
        for frames in map(reader.frames_of, reader.tasks)
        for number in np.unique(np.linspace(frames[0], frames[-1], share).astype(int))
    ]


def views_of(frames: Sequence[Frame]) -> list[tuple[str, list[View]]]:
    """What was seen, by task. Raises DataError where pictures or camera are none."""
    views: dict[str, list[View]] = {}
    for frame in frames:
        where = f"{frame.task}, episode {frame.episode}, sample {frame.frame}"
        hands = np.concatenate([frame.robot.pose[:, :3], frame.target.pose[:, :3]])
        pictures = split_cameras(frame.pictures)
        for number, picture in enumerate(pictures):
            place = where if len(pictures) == 1 else f"{where}, camera {number}"
            camera = picture.camera
            check_pictures(picture.rgb, picture.depth, place)
            check_camera(camera.intrinsics, camera.world_from_camera, picture.rgb.shape[:2], place)
            view = View(picture.depth, camera.intrinsics, camera.world_from_camera, hands)
            views.setdefault(frame.task, []).append(view)
    return list(views.items())


def _require_each_camera(reader: EpisodeReader, frames: Sequence[Frame], encoding: EncodingConfig) -> None:
    """Raises DataError if one of several cameras sees nothing of the workspace in all frames of a task.

    One camera may see little of it, such as one on the wrist above an empty table: all together are what
    `require_points` judges.
    """
    count = len(reader.cameras)
    for task, views in views_of(frames) if count > 1 else ():
        for number, name in enumerate(reader.cameras):
            found = count_points(views[number::count], encoding)
            if not found.inside:
                box = f"a reading in the workspace from {encoding.workspace_low} to {encoding.workspace_high}"
                fix = (
                    "check its world_from_camera, intrinsics and the unit of its depth, or leave it out of data.cameras"
                )
                raise DataError(f"{reader.folder}, {task}", f"camera {name}", box, f"0 of {found.readings}", fix)


def cloud_warnings(frames: Sequence[Frame], encoding: EncodingConfig) -> list[str]:
    """What training with 3D input would refuse of frames, one a task, for whoever only looks at them."""
    found = []
    for task in dict.fromkeys(frame.task for frame in frames):
        try:
            ((_, views),) = views_of([frame for frame in frames if frame.task == task])
            require_points(task, views, encoding)
        except UserError as error:
            found.append(f"3D input: {error}")
    return found


def dataset_views(opened: "OpenDataset") -> list[View]:
    """Of some evenly spaced samples of a dataset with calibrated depth, uncropped. Raises DataError at a bad depth."""
    from data_pipelines.oxe.samples import write_picture

    config = dataclasses.replace(opened.config, crop=1.0, colour_variation=0.0)
    rgb = np.empty((config.image_size, config.image_size, 3), np.uint8)
    views = []
    for number in np.unique(np.linspace(0, len(opened.index.samples) - 1, EPISODES).astype(int)):
        samples = opened.read(int(number))
        for place in np.unique(np.linspace(0, len(samples) - 1, LOOKED_AT // EPISODES).astype(int)):
            sample = samples[place]
            try:
                depth, camera = write_picture(sample, np.random.default_rng(0), config, True, rgb)
            except DataError:
                if not config.skip_bad:
                    raise
                continue
            views.append(View(depth, camera.intrinsics, camera.world_from_camera, sample.pose[:, :3]))
    if not views:
        fix = "look at its records"
        raise DataError(opened.build.folder, "depth", "some samples that can be decoded", "none", fix)
    return views


def say_points(counts: Sequence[PointCount], cameras: int = 1) -> str:
    """The mean number of points of a sample over some counts. cameras: views of each sample."""
    views = sum(count.views for count in counts) // cameras
    inside, pixels = (sum(getattr(count, name) for count in counts) / views for name in ("inside", "pixels"))
    return f"{inside:,.0f} of {pixels:,.0f} points in the workspace (mean of {views} samples)"


def say_words(reader: EpisodeReader) -> str:
    """How many episodes have an instruction."""
    labelled = len(reader)
    # Only the instructions that there are stand in the index: to count, every record is read.
    if not all(map(has_words, reader.instructions)):
        labelled = sum(has_words(reader.episode(number).instruction) for number in range(len(reader)))
    return f"{labelled:,} of {len(reader):,} episodes have an instruction"


def say_components(targets: Sequence[np.ndarray]) -> str:
    """How many of the components of targets, each (..., 8), vary, and which do not."""
    rows = np.concatenate([target.reshape(-1, len(TARGET)) for target in targets])
    still = is_constant(rows.min(axis=0), rows.max(axis=0))
    constant = [name for name, one in zip(TARGET, still, strict=True) if one]
    said = f"{len(TARGET) - len(constant)} of {len(TARGET)} components of the targets vary"
    return said + (f" (constant: {', '.join(constant)})" if constant else "")
