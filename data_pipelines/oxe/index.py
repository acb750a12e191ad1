"""One pass over a dataset: where its records are, how many samples each holds, and the statistics of their targets.

Only action and state columns are converted; no picture is decoded. The result is kept beside the data. It is made again
if the data, the values of the dataset's description, the targets asked for or `VERSION` have changed.
"""

import contextlib
import dataclasses
import glob
import hashlib
import json
import os
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from data_pipelines.oxe.dataset import OxeDataset, View
from data_pipelines.oxe.motion import Motion
from data_pipelines.oxe.targets import make_targets
from data_pipelines.rlds import files
from data_pipelines.rlds.build import RldsBuild, Shard, TFRecordFile
from data_pipelines.rlds.features import RldsEpisode
from dsvla_jax.command_line import cache_folder
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.displacement import is_constant
from dsvla_jax.encoding.text import split_words
from dsvla_jax.errors import DataError
from dsvla_jax.files import replacing
from dsvla_jax.json_values import Json
from dsvla_jax.observation_checks import check_camera, check_in_view, check_poses

VERSION = 4
"""Raise it whenever a change of the code changes the index of the same data with the same description."""
KEPT_FRAMES = 1 << 18
"""Frames whose displacements quantiles are taken from; of more, evenly spaced ones are kept."""
QUANTILES = 101
LOW, HIGH = round(0.01 * (QUANTILES - 1)), round(0.99 * (QUANTILES - 1))
"""The quantiles that displacements are binned between."""
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
DISPLACEMENT = ("x", "y", "z", "rx", "ry", "rz")


@dataclasses.dataclass(frozen=True)
class Index:
    """What one pass found.

    shards: paths. offsets: of each TFRecord shard, else None. shard, record, samples: int64 (E,), of the E usable
    episodes: where each is, and how many samples it gives. quantiles: (101, 6) of all arms' displacements, ascending,
    or None for absolute targets. low, high: (8,) or (7,), least and most of each of `components` in all targets. words:
    all words and signs of the instructions. bytes: of an average record. unlabelled: episodes without an instruction,
    which are not among the E where those are left out. left_out: record and reason, of skipped ones.
    """

    shards: list[str]
    offsets: list[np.ndarray] | None
    shard: np.ndarray
    record: np.ndarray
    samples: np.ndarray
    quantiles: np.ndarray | None
    low: np.ndarray
    high: np.ndarray
    words: list[str]
    bytes: float
    unlabelled: int
    left_out: list[tuple[str, str]]

    @property
    def num_samples(self) -> int:
        """Of all usable episodes."""
        return int(self.samples.sum())

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the parts of a target, for all arms."""
        return (*(POSE if self.quantiles is None else DISPLACEMENT), "gripper")

    @property
    def constant(self) -> tuple[str, ...]:
        """Those that do not vary, of displacements between the quantiles that are binned."""
        low, high = self.low.copy(), self.high.copy()
        if self.quantiles is not None:
            low[:6], high[:6] = self.quantiles[[LOW, HIGH]]
        return tuple(name for name, still in zip(self.components, is_constant(low, high), strict=True) if still)


def load_index(build: RldsBuild, dataset: OxeDataset, config: OxeConfig, progress: bool = True) -> Index:
    """The index of a split, from its file where that is current."""
    key = _fingerprint(build, dataset, config)
    path = _cache_path(build, dataset, config, key)
    if path is not None and path.is_file():
        # One that was cut short in copying is made again.
        with contextlib.suppress(ValueError):
            return _unpack(path.read_text())
    if path is not None:
        _report_other_versions(path, dataset, config)
    index = scan(build, dataset, config, progress)
    if not len(index.samples):
        reasons = "; ".join(f"{where}: {why}" for where, why in index.left_out[:2])
        fix = "choose another split, or look at its records" + (f" ({reasons})" if reasons else "")
        if index.unlabelled:
            fix = f"{index.unlabelled} have no instruction: set unlabelled to keep to learn from them without words"
        raise DataError(build.folder, f"split {config.split}", "at least one usable episode", "none", fix)
    _keep(index, path)
    return index


def _keep(index: Index, path: Path | None) -> None:
    """Saves the index for the next time, if that is possible; nothing depends on it."""
    problem = "no cache folder can be written"
    try:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path, shared=True) as partial:
                partial.write_text(json.dumps(_pack(index)) + "\n")
            return
    except OSError as error:
        problem = f"{path}: {error.strerror}"
    print(f"the index is not kept for the next time ({problem}); name another folder with --oxe.cache", file=sys.stderr)


def scan(build: RldsBuild, dataset: OxeDataset, config: OxeConfig, progress: bool = True) -> Index:
    """Reads every record once. Raises DataError at the first bad one, or lists it where `config.skip_bad`."""
    shards = build.shards(config.split)
    rows, spacing, left_out = [], 1, []
    places: list[tuple[int, int, int]] = []
    offsets: list[np.ndarray] = []
    words: set[str] = set()
    seen = size = count = unlabelled = 0
    low = high = None
    total = sum(shard.records for shard in shards)
    bar = tqdm(total=total, unit="episode", desc=f"index {dataset.name}", disable=not progress, leave=False)
    for number, shard in enumerate(shards):
        try:
            records = build.open_shard(shard)
            usable = len(records)
        except DataError as error:
            _leave_out(error, f"{shard.path} (all {shard.records} records)", left_out, config)
            offsets.append(np.zeros(1, np.int64))
            continue
        whole = usable == shard.records
        if isinstance(records, TFRecordFile):
            offsets.append(records.offsets)
            whole = whole and records.is_whole
        if not whole:
            _leave_out(_truncated(shard, usable), shard.path, left_out, config)
        for record in range(usable):
            where = f"{shard.path}, record {record}"
            bar.update()
            try:
                data = records.read(record)
                episode = build.parse(data, where)
                if dataset.keep is not None and not dataset.keep(episode):
                    continue
                motion = dataset.motion(episode)
                made = make_targets(motion, dataset, config)
                check_pictures(episode, dataset)
                check_camera_and_hands(episode, dataset, motion)
            except DataError as error:
                _leave_out(error, where, left_out, config)
                continue
            if not motion.instruction and len(made.frame):
                unlabelled += 1
                if config.unlabelled == "leave_out":
                    continue
            words.update(split_words(motion.instruction))
            size, count = size + len(data), count + 1
            if len(made.frame):
                places.append((number, record, len(made.frame)))
                moved = made.displacement if made.target_pose is None else made.target_pose
                parts = np.concatenate([np.asarray(moved), made.target_gripper[..., None]], axis=-1)
                least, most = parts.min(axis=(0, 1)), parts.max(axis=(0, 1))
                low = least if low is None else np.minimum(low, least)
                high = most if high is None else np.maximum(high, most)
            if made.displacement is not None:
                taken = np.arange(seen, seen + len(made.frame)) % spacing == 0
                rows.append(made.displacement[taken])
                seen += len(made.frame)
                if sum(map(len, rows)) > KEPT_FRAMES:
                    rows, spacing = [np.concatenate(rows)[::2]], 2 * spacing
        records.close()
    bar.close()
    shard_of, record_of, samples = np.array(places, np.int64).reshape(-1, 3).T
    quantiles = None
    if rows:
        quantiles = np.quantile(np.concatenate(rows).reshape(-1, 6), np.linspace(0, 1, QUANTILES), axis=0)
    return Index(
        shards=[shard.path for shard in shards],
        offsets=offsets if build.format == "tfrecord" else None,
        shard=shard_of,
        record=record_of,
        samples=samples,
        quantiles=quantiles,
        low=np.zeros(0) if low is None else low.astype(np.float64),
        high=np.zeros(0) if high is None else high.astype(np.float64),
        words=sorted(words),
        bytes=size / max(count, 1),
        unlabelled=unlabelled,
        left_out=left_out,
    )


def check_pictures(episode: RldsEpisode, dataset: OxeDataset) -> None:
    """Raises DataError unless every step has the picture that is trained on, and its depth if there is any."""
    view = main_view(dataset)
    episode.encoded(f"steps/observation/{dataset.images[view]}")
    if dataset.depth is not None:
        episode.encoded(f"steps/observation/{dataset.depth.key}")


def check_camera_and_hands(episode: RldsEpisode, dataset: OxeDataset, motion: Motion) -> None:
    """Raises DataError unless the camera of calibrated depth is one, and sees the hands at some step."""
    if dataset.depth is None:
        return
    intrinsics, poses = dataset.depth.cameras(episode)
    size = episode.picture_size(f"steps/observation/{dataset.images[main_view(dataset)]}")
    # Most cameras stand still: each is looked at once.
    rows = np.concatenate([intrinsics.reshape(len(intrinsics), -1), poses.reshape(len(poses), -1)], axis=1)
    for step in sorted(np.unique(rows, axis=0, return_index=True)[1].tolist()):
        check_camera(intrinsics[step], poses[step], size, f"{episode.where}, step {step}")
    if motion.pose is not None:
        steps = dataset.steps(episode)
        check_poses(motion.pose, episode.where)
        check_in_view(motion.pose[..., :3], intrinsics[steps], poses[steps], size, episode.where)


def main_view(dataset: OxeDataset) -> View:
    """The view that the policy sees: the primary one, or the wrist's where there is no other."""
    return "primary" if "primary" in dataset.images else "wrist"


def _truncated(shard: Shard, usable: int) -> DataError:
    fix = "copy it again, or use what is whole with --skip-bad"
    return DataError(shard.path, "records", f"{shard.records} and no bytes after them", f"{usable} whole ones", fix)


def _leave_out(error: DataError, where: str, left_out: list[tuple[str, str]], config: OxeConfig) -> None:
    if not config.skip_bad:
        raise error
    left_out.append((where, str(error).removeprefix(f"{where}: ")))


def _fingerprint(build: RldsBuild, dataset: OxeDataset, config: OxeConfig) -> str:
    """Changes if the files, their features, what the description says of them, or the targets change."""
    # A description is made of values, columns included, so that its repr is all that it means.
    meaning = dataclasses.replace(dataset, source="", notes=())
    parts = [
        str(VERSION),
        json.dumps(build.features_json, sort_keys=True),
        repr([(shard.path, shard.records, _stamp(shard.path)) for shard in build.shards(config.split)]),
        repr(meaning),
        repr((config.split, config.target, config.horizon, config.skip_bad, config.unlabelled)),
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _stamp(path: str) -> tuple[int, float | None] | None:
    # The size alone stays the same where only numbers were corrected.
    return (files.size_of(path), files.written(path)) if files.exists(path) else None


def _cache_path(build: RldsBuild, dataset: OxeDataset, config: OxeConfig, key: str) -> Path | None:
    name = f"{_name(dataset, config)}_v{VERSION}_{key[:16]}.json"
    if config.cache:
        return Path(config.cache) / name
    if not files.is_remote(build.folder) and os.access(build.folder, os.W_OK):
        return Path(build.folder) / name
    folder = cache_folder()
    return None if folder is None else folder / "oxe" / name


def _name(dataset: OxeDataset, config: OxeConfig) -> str:
    return f"dsvla_index_{dataset.name}_{config.split}"


def _report_other_versions(path: Path, dataset: OxeDataset, config: OxeConfig) -> None:
    """Prints why records are read again, if only indexes of other versions of this code are there."""
    name = _name(dataset, config)
    found = list(path.parent.glob(f"{glob.escape(name)}_*.json"))
    if found and not any(file.name.startswith(f"{name}_v{VERSION}_") for file in found):
        print(
            f"{found[0]}: written by another version of this program; {dataset.name} is read once more, and the old"
            " index can be deleted",
            file=sys.stderr,
        )


def _pack(index: Index) -> dict[str, Json]:
    def plain(value: np.ndarray | list | tuple | str | float | None) -> Json:
        if isinstance(value, np.ndarray):
            return value.tolist()
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    return {field.name: plain(getattr(index, field.name)) for field in dataclasses.fields(index)}


def _unpack(text: str) -> Index:
    # `_pack` wrote it, and the version in the file's name is that of this code.
    stored = json.loads(text)
    arrays = {name: np.array(stored[name], np.int64) for name in ("shard", "record", "samples")}
    offsets = None if stored["offsets"] is None else [np.array(row, np.int64) for row in stored["offsets"]]
    arrays |= {name: np.array(stored[name], np.float64) for name in ("low", "high")}
    quantiles = None if stored["quantiles"] is None else np.array(stored["quantiles"], np.float64)
    left_out = [(where, why) for where, why in stored["left_out"]]
    return Index(**{**stored, **arrays, "offsets": offsets, "quantiles": quantiles, "left_out": left_out})
