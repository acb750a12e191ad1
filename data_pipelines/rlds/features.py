"""One RLDS episode: a ``tf.train.Example`` read column by column as the build's own ``features.json`` says.

Only the columns that are asked for are converted. Images stay encoded until a single one is decoded. TensorFlow
Datasets' feature definitions are used; TensorFlow is not.
"""

import dataclasses
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, cast

import cv2
import numpy as np
from google.protobuf.json_format import ParseError
from google.protobuf.message import DecodeError, Message
from tensorflow_datasets.core.features import (
    Dataset,
    FeatureConnector,
    FeaturesDict,
    Image,
    Tensor,
)
from tensorflow_datasets.core.features.tensor_feature import Encoding
from tensorflow_datasets.proto import tf_example_pb2

from dsvla_jax.errors import DataError
from dsvla_jax.json_values import Json

STEPS = "steps"
# Bytes within which a picture's end marker has to be: some writers pad.
_TAIL = 64
_FIX = "is features.json that of these records? Or leave bad records out with --skip-bad"


def parse_features(json_value: Mapping[str, Json], where: object) -> dict[str, FeatureConnector]:
    """The leaves of a parsed ``features.json`` by their path, as ``steps/observation/image``."""
    try:
        features = FeatureConnector.from_json(dict(json_value))
    except (KeyError, ValueError, TypeError, AttributeError, ImportError, ParseError) as error:
        fix = "copy the build again, or install the tensorflow_datasets that wrote it"
        raise DataError(where, "features", "the features of a tfds build", str(error), fix) from error
    return dict(_leaves(features, ""))


def _leaves(feature: FeatureConnector, path: str) -> Iterator[tuple[str, FeatureConnector]]:
    if isinstance(feature, Dataset):
        yield from _leaves(feature.feature, path)
    elif isinstance(feature, FeaturesDict):
        for name, child in feature.items():
            yield from _leaves(child, f"{path}/{name}" if path else name)
    else:
        yield path, feature


class RldsEpisode:
    """One parsed record. `where` names it in errors, as ``FILE, record 3``. Axis T: steps of the episode."""

    def __init__(self, features: dict[str, FeatureConnector], record: bytes, where: str) -> None:
        self.where = where
        self._features = features
        try:
            example = tf_example_pb2.Example.FromString(record)  # pyright: ignore[reportAttributeAccessIssue]
        except DecodeError as error:
            raise DataError(where, "record", "a tf.train.Example", str(error), _FIX) from error
        self._values = example.features.feature
        self.num_steps = self._count_steps()

    def _count_steps(self) -> int:
        """What most features of the steps that the record holds agree on; `column` compares each with it."""
        counts = []
        for path, feature in self._features.items():
            simple = isinstance(feature, Tensor | Image) and _is_simple(feature)
            if path.startswith(f"{STEPS}/") and simple and path in self._values:
                counts.append(len(_list_of(self._values[path]) or ()) // max(_values_a_step(feature), 1))
        if not counts:
            raise DataError(self.where, STEPS, "at least one feature of the steps", "none", _FIX)
        # Of as many, the larger: what is damaged more often lacks something. A feature of shape (0,) has no values.
        return max(set(filter(None, counts)), key=lambda count: (counts.count(count), count), default=0)

    def __contains__(self, path: str) -> bool:
        return path in self._features

    def column(self, path: str) -> np.ndarray:
        """A numeric feature: (T, *shape) of its own dtype for a step's, (*shape) for an episode's."""
        feature = self._feature(path)
        if not is_number(feature):
            raise DataError(self.where, path, "a numeric tensor", repr(feature), "ask for another feature")
        if not _is_simple(feature):
            raise DataError(
                self.where, path, "at most one open dimension", repr(feature), "this reader leaves such features unread"
            )
        dtype, values = dtype_of(feature), self._raw(path, feature)
        rows = self.num_steps if path.startswith(f"{STEPS}/") else 1
        shape = (rows, *(-1 if size is None else size for size in shape_of(feature)))
        try:
            if _is_bytes(feature):
                unzip = zlib.decompress if _encoding(feature) == Encoding.ZLIB else bytes
                parts = [unzip(value) for value in values]
                # Put together, steps of several lengths could still fill the shape.
                if len(parts) != rows or len(set(map(len, parts))) > 1:
                    raise ValueError(f"{len(parts)} of {sorted(set(map(len, parts)))} bytes")
                array = np.frombuffer(b"".join(parts), dtype.newbyteorder("<"))
            else:
                array = np.fromiter(values, np.int64 if dtype.kind in "iub" else np.float32, count=len(values))
            array = array.astype(dtype, copy=False)
            # A dimension of -1 cannot be distinguished from no elements; without one, too few of them are an error.
            open_and_empty = not array.size and -1 in shape
            array = np.zeros([max(size, 0) for size in shape], dtype) if open_and_empty else array.reshape(shape)
        except (ValueError, zlib.error) as error:
            raise DataError(self.where, path, f"{dtype} {feature.shape} a step", str(error), _FIX) from error
        return array if path.startswith(f"{STEPS}/") else array[0]

    def encoded(self, path: str) -> Sequence[bytes]:
        """The undecoded bytes of an image or string feature, one a step."""
        feature = self._feature(path)
        if not (isinstance(feature, Image) or is_text(feature)):
            raise DataError(self.where, path, "an image or a string", repr(feature), "ask for another feature")
        values = self._raw(path, feature)
        if path.startswith(f"{STEPS}/") and len(values) != self.num_steps:
            raise DataError(self.where, path, f"{self.num_steps} values", str(len(values)), _FIX)
        return values

    def text(self, path: str) -> list[str]:
        """A string feature, one a step (or a single one)."""
        try:
            return [value.decode() for value in self.encoded(path)]
        except UnicodeDecodeError as error:
            raise DataError(self.where, path, "UTF-8", str(error), _FIX) from error

    def image(self, path: str, step: int) -> np.ndarray:
        """One decoded image: its own dtype, (H, W, C)."""
        return decode_image(
            self.encoded(path)[step], image_format(self._feature(path)), f"{self.where}, step {step}, {path}"
        )

    def picture_size(self, path: str) -> tuple[int, int]:
        """(height, width) of the pictures of a step's image feature, or where that leaves it open of the first one."""
        height, width, _ = image_format(self._feature(path)).shape
        return self.image(path, 0).shape[:2] if height is None or width is None else (height, width)

    def _feature(self, path: str) -> FeatureConnector:
        if path not in self._features:
            near = ", ".join(sorted(name for name in self._features if name.split("/")[0] == path.split("/")[0]))
            raise DataError(self.where, path, "a feature of this build", "none of that name", f"it has: {near}")
        return self._features[path]

    def _raw(self, path: str, feature: FeatureConnector) -> Any:  # noqa: ANN401, bytes or numbers
        """The values of a leaf as protobuf keeps them, bytes or numbers as the feature says."""
        if path not in self._values:
            raise DataError(self.where, path, "to be present", "nothing", _FIX)
        values = self._values[path]
        kind = "bytes_list" if _is_bytes(feature) else _kind(dtype_of(feature))
        found = values.WhichOneof("kind")
        if found is None:
            return ()
        if found != kind:
            raise DataError(self.where, path, f"{kind} ({feature.np_dtype})", found, _FIX)
        return getattr(values, kind).value


@dataclasses.dataclass(frozen=True)
class ImageFormat:
    """What an Image feature says of its pictures. shape: (H, W, C), None where open.

    bgr: whether blue was given for red when the picture was written, which no feature says.
    """

    shape: tuple[int | None, ...]
    dtype: np.dtype
    bgr: bool = False


def image_format(feature: FeatureConnector, bgr: bool = False) -> ImageFormat:
    """The format of an Image feature."""
    return ImageFormat(tuple(shape_of(feature)), dtype_of(feature), bgr)


def decode_image(data: bytes, kind: ImageFormat, where: object) -> np.ndarray:
    """The (H, W, C) picture of an Image feature, in its own dtype; RGB order. JPEG or PNG, of 8 or 16 bits.

    A float32 Image is a four-channel PNG whose bytes are the numbers', as tfds writes it.
    """
    colour = kind.shape[-1] == 3 and kind.dtype == np.uint8
    order = cv2.IMREAD_COLOR_BGR if kind.bgr else cv2.IMREAD_COLOR_RGB
    flag = order | cv2.IMREAD_IGNORE_ORIENTATION if colour else cv2.IMREAD_UNCHANGED
    if not _is_whole(data):
        raise DataError(where, "image", "a whole JPEG or PNG", f"{len(data)} bytes without its end", _FIX)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
    if picture is None:
        raise DataError(where, "image", "a JPEG or PNG", f"{len(data)} undecodable bytes", _FIX)
    if not colour:
        if picture.ndim == 3:
            picture = cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA if picture.shape[-1] == 4 else cv2.COLOR_BGR2RGB)
        if kind.dtype == np.float32:
            picture = np.ascontiguousarray(picture).view(np.float32)
        picture = picture.reshape(*picture.shape[:2], -1)
    fits = all(size in (None, got) for size, got in zip(kind.shape, picture.shape, strict=True))
    if picture.dtype != kind.dtype or not fits:
        raise DataError(where, "image", f"{kind.dtype} {kind.shape}", f"{picture.dtype} {picture.shape}", _FIX)
    return picture


def _is_whole(data: bytes) -> bool:
    """Whether an encoded picture has its end: the decoder fills what is missing with one colour, and says nothing."""
    return b"\xff\xd9" in data[-_TAIL:] or b"IEND" in data[-_TAIL:]


def shape_of(feature: FeatureConnector) -> tuple[int | None, ...]:
    """The shape of a leaf, None for open dimensions; tfds' own type allows for trees."""
    return cast(tuple[int | None, ...], feature.shape)


def dtype_of(feature: FeatureConnector) -> np.dtype:
    """The dtype of a leaf; tfds' own type allows for trees."""
    return np.dtype(cast(type[np.generic], feature.np_dtype))


def is_text(feature: FeatureConnector) -> bool:
    """Whether a feature holds strings."""
    return _is_tensor(feature) and dtype_of(feature) == np.object_


def is_number(feature: FeatureConnector) -> bool:
    """Whether a feature is a tensor of numbers or truth values."""
    return _is_tensor(feature) and not is_text(feature)


def _encoding(feature: FeatureConnector) -> Encoding:
    return feature._encoding if isinstance(feature, Tensor) else Encoding.NONE


def _is_tensor(feature: FeatureConnector) -> bool:
    return isinstance(feature, Tensor)


def _values_a_step(feature: FeatureConnector) -> int:
    return 1 if _is_bytes(feature) else int(np.prod(np.array(shape_of(feature), int)))


def _is_bytes(feature: FeatureConnector) -> bool:
    """Whether a value is stored as one string of bytes."""
    return isinstance(feature, Image) or is_text(feature) or _encoding(feature) != Encoding.NONE


def _is_simple(feature: FeatureConnector) -> bool:
    """Whether a value is stored under the feature's own name (several open dimensions take two names)."""
    return isinstance(feature, Image) or shape_of(feature).count(None) <= (1 if _is_bytes(feature) else 0)


def _list_of(values: Message) -> Sequence[bytes | int | float] | None:
    kind = values.WhichOneof("kind")
    return None if kind is None else getattr(values, kind).value


@cache
def _kind(dtype: np.dtype) -> str:
    return "int64_list" if np.dtype(dtype).kind in "iub" else "float_list"
