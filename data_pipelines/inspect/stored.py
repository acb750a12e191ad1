"""What an RLDS build stores: its features and shards, and a page of raw values where it cannot be trained on."""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import cast

import cv2
import numpy as np
from tensorflow_datasets.core.features import FeatureConnector, Image

from data_pipelines.inspect.motions import STATISTICS, draw_motion, motion_statistics, statistics_row
from data_pipelines.inspect.page import Page, Section, Table
from data_pipelines.oxe.dataset import OxeDataset
from data_pipelines.oxe.index import main_view
from data_pipelines.oxe.motion import Motion
from data_pipelines.rlds import files
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.features import RldsEpisode, dtype_of, image_format, is_number, is_text, shape_of
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.errors import DataError
from dsvla_jax.evaluation.pictures import MAX_STRIP_FRAMES, film_strip

LOOKED_AT = 50
"""Episodes, the first ones, that are read."""
WIDE = 16
"""Features with more values a step than this are not broken down."""


def feature_table(build: RldsBuild) -> Table:
    """Every feature with its type and shape."""

    def kind(feature: FeatureConnector) -> str:
        dtype = dtype_of(feature)
        return "text" if is_text(feature) else f"picture, {dtype}" if isinstance(feature, Image) else str(dtype)

    rows = [
        (path, kind(feature), " x ".join("any" if size is None else str(size) for size in shape_of(feature)))
        for path, feature in _features(build)
    ]
    return Table("features of an episode", ("feature", "type", "shape"), rows, numbers=False)


def _features(build: RldsBuild) -> list[tuple[str, FeatureConnector]]:
    return list(build.features.items())


def shard_table(build: RldsBuild) -> Table:
    """How many files and episodes each split has, and how large they are."""
    rows = []
    for split in build.splits:
        shards = build.shards(split)
        sizes = [files.size_of(shard.path) / 1e6 for shard in shards if files.exists(shard.path)]
        episodes = [shard.records for shard in shards]
        rows.append(
            (
                split,
                str(len(shards)),
                str(len(shards) - len(sizes)),
                f"{sum(episodes):,}",
                f"{min(episodes, default=0)} to {max(episodes, default=0)}",
                f"{sum(sizes):,.2f}",
                f"{min(sizes, default=0):.2f} to {max(sizes, default=0):.2f}",
            )
        )
    columns = ("split", "shards", "not there", "episodes", "episodes a shard", "MB", "MB a shard")
    return Table(f"shards, {build.format}; episodes as dataset_info.json counts them", columns, rows)


def describe_stored(
    build: RldsBuild, dataset: OxeDataset | None, config: OxeConfig, shown: int, tables: Sequence[Table], warning: str
) -> Page:
    """The page of a build that cannot be trained on: its motion where the registry knows it, else raw values."""
    warnings = [warning]
    read = list(islice(_episodes(build, dataset, config, warnings), LOOKED_AT))
    if not read:
        fix = "choose another split, or copy the build again"
        raise DataError(build.folder, f"split {config.split}", "at least one readable episode", "none", fix)
    motions = [motion for _, motion in read if motion is not None]
    values = motion_statistics(motions) if motions else _values(build, [episode for episode, _ in read])
    sections = [_section(episode, motion, build, dataset) for episode, motion in read[:shown]]
    total = sum(shard.records for shard in build.shards(config.split))
    return Page(f"{build.folder}: {total:,} episodes", [*tables, values], warnings, sections)


def _episodes(
    build: RldsBuild, dataset: OxeDataset | None, config: OxeConfig, warnings: list[str]
) -> Iterator[tuple[RldsEpisode, Motion | None]]:
    for shard in build.shards(config.split):
        records = build.open_shard(shard)
        for number in range(len(records)):
            try:
                episode = build.parse(records.read(number), f"{shard.path}, record {number}")
                yield episode, dataset.motion(episode) if dataset else None
            except DataError as error:
                if not config.skip_bad:
                    raise
                warnings.append(f"left out: {error}")
        records.close()


def _values(build: RldsBuild, episodes: Sequence[RldsEpisode]) -> Table:
    """Statistics of the numbers of every step, feature by feature."""
    rows = []
    for path, feature in _features(build):
        size = int(np.prod([size or 0 for size in cast(tuple[int | None, ...], feature.shape)]))
        if not path.startswith("steps/") or not is_number(feature) or not 0 < size <= WIDE:
            continue
        values = np.concatenate([episode.column(path).reshape(-1, size) for episode in episodes]).astype(np.float64)
        names = [path] if size == 1 else [f"{path} [{i}]" for i in range(size)]
        rows += [statistics_row(name, values[:, i]) for i, name in enumerate(names)]
    return Table(f"stored values, of {len(episodes)} episodes", STATISTICS, rows)


def _section(episode: RldsEpisode, motion: Motion | None, build: RldsBuild, dataset: OxeDataset | None) -> Section:
    """The registry's view, or all colour pictures; the motion where it is known; the texts of the first step."""
    steps = [(path, feature) for path, feature in _features(build) if path.startswith("steps/")]
    views = [path for path, feature in steps if isinstance(feature, Image) and image_format(feature).shape[-1] == 3]
    if dataset is not None:
        views = [f"steps/observation/{dataset.images[main_view(dataset)]}"]
    drawn: list[tuple[str, np.ndarray]] = []
    for view in views if episode.num_steps else []:
        chosen = np.unique(np.linspace(0, episode.num_steps - 1, MAX_STRIP_FRAMES).round().astype(int))
        frames = [episode.image(view, int(step)) for step in chosen]
        height, width = frames[0].shape[:2]
        drawn.append((view, film_strip([cv2.resize(frame, (width, height)) for frame in frames])))
    if motion is not None:
        drawn.append(("the motion", draw_motion(motion)))
    texts = [f"{path}: {episode.text(path)[0]}" for path, feature in steps if is_text(feature) and episode.num_steps]
    return Section(f"{episode.where}: {episode.num_steps} steps", drawn, texts)
