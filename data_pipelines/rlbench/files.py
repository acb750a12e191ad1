"""RLBench's, PerAct's and PerAct2's episode folders, read as recordings.

    {task}/all_variations/episodes/episode{N}/       PerAct, PerAct2
    {task}/variation{V}/episodes/episode{N}/         RLBench
        low_dim_obs.pkl                              what the robot felt, and the cameras
        {camera}_rgb/{i}.png, {camera}_depth/{i}.png               PerAct2: rgb_{i:04d}.png, depth_{i:04d}.png
        variation_descriptions.pkl                   instructions; RLBench keeps them in variation{V}/
        variation_number.pkl

Sources: ``rlbench/utils.py`` and ``tools/dataset_generator.py`` of stepjam/RLBench and of its forks for PerAct and
PerAct2; ``rlbench/backend/utils.py`` for how depth is packed into PNG.
"""

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import SupportsIndex, cast

import cv2
import numpy as np

from data_pipelines.recording import CameraRecording, Recording
from data_pipelines.records import mark_missing
from data_pipelines.rlbench.unpickle import Node, read_pickle, to_array
from dsvla_jax.errors import DataError

_FIX = "copy or unpack the data set again, or leave such episodes out with --skip-bad"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
# What a depth PNG counts to: 24 bits in red, green and blue.
_DEPTH_SCALE = 2**24 - 1


def find_episodes(source: Path) -> dict[str, list[Path]]:
    """Episode folders by task, in numerical order.

    source: a task's folder, a folder of tasks, or one that holds a single such folder (a split such as `train`).
    Raises DataError where there are none, or where several splits would be mixed.
    """
    for depth in range(3):
        found = [
            path
            for name in ("all_variations", "variation[0-9]*")
            for path in source.glob("*/" * depth + f"{name}/episodes/episode*")
            if path.is_dir()
        ]
        if found:
            break
    else:
        expected = "TASK/all_variations/episodes/episode0 or TASK/variation0/episodes/episode0 in it"
        raise DataError(source, "folder", expected, "none", "name the folder that holds the tasks of one split")
    splits = sorted({path.parents[3].name for path in found})
    if depth == 2 and len(splits) > 1:
        fix = f"import each by itself, such as {source / splits[0]}, so that test data stay apart"
        raise DataError(source, "folder", "tasks, or one split", ", ".join(splits), fix)
    tasks: dict[str, list[Path]] = {}
    for path in sorted(found, key=_episode_number):
        tasks.setdefault(path.resolve().parents[2].name, []).append(path)
    return dict(sorted(tasks.items()))


def _episode_number(path: Path) -> tuple[str, list[tuple[int, str]]]:
    def number(name: str) -> tuple[int, str]:
        digits = "".join(c for c in name if c.isdigit())
        return int(digits or -1), name

    return str(path.parents[2]), [number(path.parents[1].name), number(path.name)]


def read_recording(
    folder: Path, task: str, cameras: Sequence[str] = ("front",), keyframes_only: bool = False
) -> tuple[Recording, np.ndarray]:
    """An episode's recording by some cameras, and its joint velocities (T, A, 7). Pictures are read when asked for.

    The instruction is the first of the descriptions, as in PerAct. The recording has no keypoints: RLBench keeps none.
    keyframes_only: for copies that kept the pictures of keyframes only; the others are missed when asked for.
    Raises DataError naming file and observation where anything is missing or damaged.
    """
    path = folder / "low_dim_obs.pkl"
    demo = read_pickle(path)
    observations = demo.state.get("_observations") if isinstance(demo, Node) and isinstance(demo.state, dict) else demo
    if not isinstance(observations, list) or not all(isinstance(item, Node) for item in observations):
        raise DataError(path, "pickle", "a Demo with a list of observations", str(type(observations).__name__), _FIX)
    if len(observations) < 2:
        raise DataError(path, "observations", "at least 2", str(len(observations)), _FIX)
    arms = [[item] for item in observations]
    if observations[0].has("left"):
        arms = [[_field(item, side, i, path) for side in ("left", "right")] for i, item in enumerate(observations)]

    def felt(field: str, shape: tuple[int, ...]) -> np.ndarray:
        rows = [[_numbers(arm, field, shape, i, path) for arm in row] for i, row in enumerate(arms)]
        return np.array(rows)

    def seen(camera: str, field: str, shape: tuple[int, ...]) -> np.ndarray:
        name = f"{camera}_camera_{field}"
        return np.array(
            [_numbers(_field(item, "misc", i, path), name, shape, i, path) for i, item in enumerate(observations)]
        )

    count = len(observations)

    def recorded(camera: str) -> CameraRecording:
        _check_camera_name(camera, _field(observations[0], "misc", 0, path), path)
        near, far = seen(camera, "near", ()), seen(camera, "far", ())
        intrinsics = seen(camera, "intrinsics", (3, 3))
        return CameraRecording(
            rgb=_Pictures(folder, f"{camera}_rgb", count, keyframes_only),
            depth=_DepthMaps(folder, f"{camera}_depth", count, keyframes_only, near, far),
            intrinsics=intrinsics,
            world_from_camera=seen(camera, "extrinsics", (4, 4)),
        )

    name, *others = cameras
    first = recorded(name)
    recording = Recording(
        task=task,
        instruction=_instruction(folder),
        rgb=first.rgb,
        depth=first.depth,
        intrinsics=first.intrinsics,
        world_from_camera=first.world_from_camera,
        camera=name,
        other_cameras={other: recorded(other) for other in others},
        pose=felt("gripper_pose", (7,)),
        gripper_open=felt("gripper_open", ()),
        variation=_variation(folder),
    )
    return recording, felt("joint_velocities", (7,))


def left_aside(folder: Path, cameras: Sequence[str]) -> list[str]:
    """The folders of an episode that are not read: masks, point clouds and other cameras."""
    kinds = {path.name for path in folder.iterdir() if path.is_dir()}
    return sorted(kinds - {f"{camera}_{kind}" for camera in cameras for kind in ("rgb", "depth")})


def _check_camera_name(camera: str, misc: object, path: Path) -> None:
    ending = "_camera_extrinsics"
    names = [str(name) for name in misc] if isinstance(misc, dict) else []
    cameras = sorted(name.removesuffix(ending) for name in names if name.endswith(ending))
    if cameras and not any(name.startswith(f"{camera}_camera_") for name in names):
        raise DataError(path, "camera", f"one of {', '.join(cameras)}", repr(camera), "choose one with --cameras")


def _field(record: object, name: str, number: int, path: Path) -> object:
    """An attribute of a pickled object or an entry of a pickled dict."""
    try:
        return record.field(name) if isinstance(record, Node) else cast(Mapping[str, object], record)[name]
    except (KeyError, TypeError) as error:
        raise DataError(path, f"observation {number}: {name}", "to be recorded", "nothing", _FIX) from error


def _numbers(record: object, name: str, shape: tuple[int, ...], number: int, path: Path) -> np.ndarray:
    value = _field(record, name, number, path)
    try:
        array = to_array(value).astype(np.float64)
    except (ValueError, TypeError) as error:
        raise DataError(path, f"observation {number}: {name}", f"numbers {shape}", str(error), _FIX) from error
    if array.shape != shape:
        raise DataError(path, f"observation {number}: {name}", f"numbers {shape}", str(array.shape), _FIX)
    if not np.isfinite(array).all():
        raise DataError(path, f"observation {number}: {name}", "finite numbers", str(array.tolist()), _FIX)
    return array


def _instruction(folder: Path) -> str:
    name = "variation_descriptions.pkl"
    path = next((place / name for place in (folder, folder.parents[1]) if (place / name).exists()), folder / name)
    texts = read_pickle(path)
    if not isinstance(texts, list) or not texts or not all(isinstance(text, str) and text.strip() for text in texts):
        raise DataError(path, "descriptions", "a list of texts", repr(texts)[:60], _FIX)
    return texts[0]


def _variation(folder: Path) -> int:
    path = folder / "variation_number.pkl"
    if not path.exists() and folder.parents[1].name != "all_variations":
        return int("".join(c for c in folder.parents[1].name if c.isdigit()))
    try:
        number = to_array(read_pickle(path))
    except ValueError as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, "variation", "a number", str(error), _FIX) from error
    if number.shape != () or number.dtype.kind not in "iu":
        raise DataError(path, "variation", "a whole number", repr(number.tolist())[:60], _FIX)
    return int(number)


class _Pictures(Sequence[np.ndarray]):
    """The colour pictures of one camera, read when asked for.

    Raises DataError unless there is one an observation; with `keyframes_only` one that is missing is missed when asked
    for. Leading zeros do not count. Hidden files are passed over: archives of macOS have them.
    """

    def __init__(self, folder: Path, name: str, count: int, keyframes_only: bool) -> None:
        self.folder, self.total, self.keyframes_only = folder / name, count, keyframes_only
        files = [path.name for path in sorted(self.folder.glob("[!.]*.png"))]
        if not files:
            kind = name.rsplit("_", 1)[1]
            others = sorted({path.parent.name.removesuffix(f"_{kind}") for path in folder.glob(f"*_{kind}/[!.]*.png")})
            got = f"none, but those of {', '.join(others)}" if others else "none"
            fix = f"choose one of these with --cameras, or {_FIX}" if others else _FIX
            raise DataError(self.folder, "folder", f"{count} pictures", got, fix)
        digits = ["".join(c for c in file if c.isdigit()) for file in files]
        self.names = {int(number): file for number, file in zip(digits, files, strict=True) if number}
        before, width = files[0][: files[0].find(digits[0])], len(digits[0]) if digits[0].startswith("0") else 1
        self.form = f"{before}{{:0{width}d}}.png"
        if 0 not in self.names and count in self.names:
            fix = "number the files from 0, in the order of the observations"
            raise DataError(self.folder, "folder", f"pictures 0 to {count - 1}", f"1 to {count}", fix)
        if len(files) > len(self.names.keys() & range(count)):
            raise DataError(self.folder, "folder", f"{count} pictures, one an observation", str(len(files)), _FIX)
        missing = [number for number in range(count) if number not in self.names]
        if missing and not keyframes_only:
            if len(files) < count / 2:
                fix = f"if they are those of keyframes, import with --every-n 0; otherwise {_FIX}"
                got = f"{len(files)} (no {self.form.format(missing[0])})"
                raise DataError(self.folder, "folder", f"pictures of all {count} observations", got, fix)
            raise self._missing(missing[0])

    def _missing(self, number: int) -> DataError:
        expected = f"a picture of each of {self.total} observations"
        if self.keyframes_only:
            expected = "a picture of the first observation and of each keyframe"
        return DataError(self.folder / self.form.format(number), "file", expected, "no such file", _FIX)

    def __len__(self) -> int:
        return self.total

    # Nobody takes slices.
    def __getitem__(self, number: SupportsIndex) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        if int(number) not in self.names:
            raise self._missing(int(number))
        return read_png(self.folder / self.names[int(number)])


class _DepthMaps(_Pictures):
    """The depth maps of one camera in metres, 0 where missing."""

    def __init__(
        self, folder: Path, name: str, count: int, keyframes_only: bool, near: np.ndarray, far: np.ndarray
    ) -> None:
        super().__init__(folder, name, count, keyframes_only)
        self.near, self.far = near, far

    # Nobody takes slices.
    def __getitem__(self, number: SupportsIndex) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        near, far = float(self.near[number]), float(self.far[number])
        depth = unpack_depth(super().__getitem__(number), near, far)
        # At the far plane nothing was hit.
        return mark_missing(np.where(depth < far, depth, 0))


def unpack_depth(picture: np.ndarray, near: float, far: float) -> np.ndarray:
    """Planar depth float64 (H, W) in metres of uint8 (H, W, 3): 24 bits, red the highest, from `near` to `far`."""
    share = picture.astype(np.int64) @ np.array([65536, 256, 1]) / _DEPTH_SCALE
    return near + share * (far - near)


def read_png(path: Path) -> np.ndarray:
    """uint8 (H, W, 3), red first, of an 8-bit colour PNG. Raises DataError naming the file where it is damaged."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(path, "file", "a PNG", error.strerror or str(error), _FIX) from error
    _check_png(data, path)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[-1] != 3:
        got = "undecodable" if picture is None else f"{picture.dtype} {picture.shape}"
        raise DataError(path, "picture", "8-bit red, green and blue", got, _FIX)
    return np.ascontiguousarray(picture[..., ::-1])


def _check_png(data: bytes, path: Path) -> None:
    """Decoders fill the rest of a truncated picture with black, so lengths and check sums are compared here."""
    if not data.startswith(_PNG_START):
        raise DataError(path, "picture", "a PNG", f"{len(data)} bytes that are none", _FIX)
    place, kind = len(_PNG_START), b""
    while kind != _PNG_END:
        length = int.from_bytes(data[place : place + 4], "big")
        kind, end = data[place + 4 : place + 8], place + 8 + length
        if end + 4 > len(data):
            raise DataError(path, "picture", "a whole PNG", f"only its first {len(data)} bytes", _FIX)
        if zlib.crc32(data[place + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise DataError(path, "picture", "the check sums of its parts", f"another one of {kind!r}", _FIX)
        place = end + 4
