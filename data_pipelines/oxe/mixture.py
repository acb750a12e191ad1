"""Datasets opened and mixed: random access to the samples of an endless stream, with pictures still encoded."""

import dataclasses
import operator
import threading
from collections.abc import Sequence
from contextlib import closing
from typing import SupportsIndex

import grain
import numpy as np

from data_pipelines.oxe.dataset import OxeDataset, View
from data_pipelines.oxe.index import Index, load_index, main_view
from data_pipelines.oxe.order import BlockOrder, deal, recent, schedule
from data_pipelines.oxe.registry import get_dataset, get_mixture
from data_pipelines.oxe.targets import Targets, make_targets, why_unsupported
from data_pipelines.rlds import files
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.features import ImageFormat, RldsEpisode, image_format
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.errors import DataError, UserError

ENDLESS = 1 << 40


@dataclasses.dataclass(frozen=True)
class CalibratedDepth:
    """The camera and the depth map of one picture.

    intrinsics: float32 (3, 3). world_from_camera: float32 (4, 4). depth: encoded, counts of `depth_unit` metres.
    """

    intrinsics: np.ndarray
    world_from_camera: np.ndarray
    depth_unit: float
    depth: bytes
    depth_format: ImageFormat


@dataclasses.dataclass(frozen=True)
class EncodedSample:
    """One frame with its picture encoded. pose, target_pose: (A, 7). displacement: (A, 6). grippers: (A,)."""

    dataset: str
    where: str
    instruction: str
    picture: bytes
    format: ImageFormat
    camera: CalibratedDepth | None
    pose: np.ndarray
    gripper_open: np.ndarray
    target_pose: np.ndarray | None
    displacement: np.ndarray | None
    target_gripper: np.ndarray


class OpenDataset:
    """One dataset of the mixture: its build, its index, and its episodes one by one."""

    def __init__(self, build: RldsBuild, dataset: OxeDataset, config: OxeConfig, progress: bool = True) -> None:
        self.build, self.dataset, self.config = build, dataset, config
        self.view: View = main_view(dataset)
        self.index: Index = load_index(self.build, dataset, config, progress)
        if config.unlabelled == "refuse" and self.index.unlabelled:
            got = f"{self.index.unlabelled} of {self.num_episodes} without"
            raise DataError(build.folder, "instructions", "one an episode", got, "set unlabelled to leave_out or keep")
        self._shards = build.shards(config.split)

    @property
    def num_episodes(self) -> int:
        """Usable ones, and those that are left out for want of an instruction."""
        left_out = self.index.unlabelled if self.config.unlabelled == "leave_out" else 0
        return len(self.index.samples) + left_out

    def parse(self, episode: int) -> RldsEpisode:
        """The usable episode of that number as it is stored."""
        shard, record = int(self.index.shard[episode]), int(self.index.record[episode])
        offsets = None if self.index.offsets is None else self.index.offsets[shard]
        # Opened anew, which is quick: over streams and datasets kept files would be more than a process may have.
        with closing(self.build.open_shard(self._shards[shard], offsets)) as records:
            return self.build.parse(records.read(record), f"{self.index.shards[shard]}, record {record}")

    def read(self, episode: int) -> list[EncodedSample]:
        """All samples of an episode."""
        parsed = self.parse(episode)
        motion = self.dataset.motion(parsed)
        return self._samples(parsed, motion.instruction, make_targets(motion, self.dataset, self.config))

    def _samples(self, episode: RldsEpisode, instruction: str, targets: Targets) -> list[EncodedSample]:
        path = f"steps/observation/{self.dataset.images[self.view]}"
        pictures, steps = list(episode.encoded(path)), self.dataset.steps(episode)
        cameras = self._cameras(episode)
        bgr = self.view in self.dataset.bgr and not self.config.colours_mended
        kind = image_format(self.build.features[path], bgr)
        return [
            EncodedSample(
                dataset=self.dataset.name,
                where=f"{episode.where}, step {steps[frame]}, {path}",
                instruction=instruction,
                picture=pictures[steps[frame]],
                format=kind,
                camera=cameras[steps[frame]] if cameras else None,
                pose=targets.pose[i],
                gripper_open=targets.gripper_open[i],
                target_pose=None if targets.target_pose is None else targets.target_pose[i],
                displacement=None if targets.displacement is None else targets.displacement[i],
                target_gripper=targets.target_gripper[i],
            )
            for i, frame in enumerate(targets.frame)
        ]

    def _cameras(self, episode: RldsEpisode) -> list[CalibratedDepth]:
        depth = self.dataset.depth
        if depth is None:
            return []
        intrinsics, poses = depth.cameras(episode)
        path = f"steps/observation/{depth.key}"
        encoded, kind = list(episode.encoded(path)), image_format(self.build.features[path])
        return [
            CalibratedDepth(intrinsics[i], poses[i], depth.unit, encoded[i], kind) for i in range(episode.num_steps)
        ]


def describe_dataset(opened: OpenDataset) -> str:
    """One line: how many episodes have words, and which components of the targets vary."""
    index, episodes = opened.index, opened.num_episodes
    line = f"{opened.dataset.name}: {episodes - index.unlabelled:,} of {episodes:,} episodes have an instruction"
    if index.unlabelled:
        line += "; the others are " + ("left out" if opened.config.unlabelled == "leave_out" else "kept")
    constant = index.constant
    varying = len(index.components) - len(constant)
    line += f"; {varying} of {len(index.components)} components of the targets vary"
    return line + (f" (constant: {', '.join(constant)})" if constant else "")


class Stream:
    """One stream's samples of one dataset; at most `keep` blocks of episodes are in memory."""

    def __init__(self, source: OpenDataset, episodes: np.ndarray, window: int, seed: list[int], keep: int) -> None:
        self._source, self._episodes, self._keep = source, episodes, keep
        self._order = BlockOrder(source.index.samples[episodes], window, seed, keep)
        self._blocks: dict[tuple[int, int], dict[int, list[EncodedSample]]] = {}
        self._lock = threading.Lock()

    def sample(self, number: int) -> EncodedSample:
        """The stream's sample of that number, counted through all epochs."""
        with self._lock:
            block, episode, place = self._order.locate(number)
            self._blocks.setdefault(block, {})
            loaded = recent(self._blocks, block, self._keep)
            if episode not in loaded:
                loaded[episode] = self._source.read(int(self._episodes[episode]))
            return loaded[episode][place]


class MixtureSource(grain.sources.RandomAccessDataSource[EncodedSample]):
    """The endless, shuffled stream of a mixture by sample number; the same whoever reads which numbers.

    Number i belongs to stream i mod `config.streams`. A stream has its own episodes of every dataset.
    """

    def __init__(self, config: OxeConfig, seed: int, progress: bool = True, at_once: int = 1) -> None:
        """at_once: of how many successive numbers threads may ask for any; few records are then read twice."""
        self.config, self.seed = config, seed
        self.datasets, self.weights = open_mixture(config, progress)
        self.shares = shares_of(self.datasets, self.weights)
        for source in self.datasets:
            if len(source.index.samples) < config.streams:
                raise UserError(
                    f"{source.build.folder}: {len(source.index.samples)} usable episodes cannot be dealt to"
                    f" {config.streams} streams; lower `streams` to that, or leave the dataset out"
                )
        window = max(1, -(-config.window // config.streams))
        self._schedules = [schedule(self.shares, [seed, stream]) for stream in range(config.streams)]
        # The same for every stream.
        self._turns = np.bincount(self._schedules[0][0], minlength=len(self.datasets))
        self._streams = []
        for number, source in enumerate(self.datasets):
            dealt = deal(len(source.index.samples), config.streams, [seed, number])
            # As many blocks as those numbers can span, and some more since blocks differ in size: with fewer, threads
            # would take each other's away.
            spanned = at_once / config.streams * self.shares[number] / (window * source.index.samples.mean())
            keep = 2 + int(1.5 * spanned)
            made = [Stream(source, episodes, window, [seed, number, i], keep) for i, episodes in enumerate(dealt)]
            self._streams.append(made)

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, record_key: SupportsIndex) -> EncodedSample:
        place, stream = divmod(operator.index(record_key), self.config.streams)
        dataset, occurrence = self._schedules[stream]
        cycle, place = divmod(place, len(dataset))
        number = int(dataset[place])
        return self._streams[number][stream].sample(cycle * int(self._turns[number]) + int(occurrence[place]))

    def __repr__(self) -> str:
        sizes = [(source.dataset.name, source.index.num_samples) for source in self.datasets]
        shape = (self.seed, self.config.streams, self.config.window)
        return f"MixtureSource(datasets={sizes}, weights={self.weights.tolist()}, seed, streams, window={shape})"

    @property
    def num_samples(self) -> int:
        """Of all datasets, each once."""
        return sum(source.index.num_samples for source in self.datasets)

    @property
    def words(self) -> list[str]:
        """All words and signs of the instructions."""
        return sorted({word for source in self.datasets for word in source.index.words})

    @property
    def left_out(self) -> list[tuple[str, str]]:
        """Records that were skipped, and why."""
        return [entry for source in self.datasets for entry in source.index.left_out]


def open_mixture(config: OxeConfig, progress: bool = True) -> tuple[list[OpenDataset], np.ndarray]:
    """The datasets of a mixture, and their weights (D,). Raises UserError where one is missing or cannot be used."""
    weights = get_mixture(config.mixture)
    reasons = {name: why_unsupported(get_dataset(name), config) for name in weights}
    refused = {name: reason for name, reason in reasons.items() if reason}
    if refused and config.unsupported == "refuse":
        listed = "; ".join(f"{name}: {reason}" for name, reason in refused.items())
        fix = "Set target to relative, choose" if config.target == "absolute" else "Choose"
        raise UserError(
            f"mixture: some datasets cannot give {config.target} targets: {listed}. {fix} others, or set unsupported to"
            " leave_out"
        )
    kept = [name for name in weights if name not in refused]
    if not kept:
        raise UserError(f"mixture: no dataset of {', '.join(weights)} can give {config.target} targets")
    if len({get_dataset(name).frame for name in kept}) > 1 and config.target == "relative":
        tools = [name for name in kept if get_dataset(name).frame == "tool"]
        raise UserError(f"mixture: displacements of {', '.join(tools)} are in the tool's frame; train on them alone")
    datasets = [get_dataset(name) for name in kept]
    builds = [RldsBuild(folder_of(dataset, config)) for dataset in datasets]
    opened = [OpenDataset(build, dataset, config, progress) for build, dataset in zip(builds, datasets, strict=True)]
    return opened, np.array([weights[name] for name in kept])


def shares_of(datasets: Sequence[OpenDataset], weights: np.ndarray) -> np.ndarray:
    """(D,): each dataset's share of the samples, its weight times its size, adding up to 1."""
    sizes = weights * np.array([source.index.num_samples for source in datasets], float)
    return sizes / sizes.sum()


def folder_of(dataset: OxeDataset, config: OxeConfig) -> str:
    """Where the dataset is, or the version of it that the registry is about. Raises UserError where it is not."""
    folder = files.join(config.folder, dataset.name)
    if not files.exists(folder):
        raise UserError(
            f"{folder}: no such dataset; copy it there from {dataset.source}, or choose another folder or mixture"
        )
    return files.join(folder, dataset.version) if dataset.version else folder
