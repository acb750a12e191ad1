"""Messages on the wire: msgpack with NumPy arrays in it, in the format of the `openpi-client` package.

An array is a map of the bytes keys `__ndarray__`, `data`, `dtype` and `shape`, a NumPy scalar one of `__npgeneric__`,
`data` and `dtype` (github.com/Physical-Intelligence/openpi, packages/openpi-client, msgpack_numpy.py). Nothing that is
read can execute, and what may be read is bounded before it is built.
"""

import math
from typing import Any, TypeAlias, TypeVar

import msgpack
import numpy as np

from dsvla_jax.errors import UserError

Container = TypeVar("Container")

MAX_CONTAINERS = 512  # maps and lists in a message: an empty one costs one byte to send and sixty to hold
MAX_DIMENSIONS = 8
_KINDS = "biuf"  # bool, integers, floats

Message: TypeAlias = dict[str, Any]
"""A map of plain values and NumPy arrays by field: the wire has no types. `requests.parse_request` checks what a robot
sends; what a server sends is described in docs/serving.md."""


class MessageError(UserError):
    """Bytes that are not a message of this format, or one beyond its limits."""


def pack(value: object) -> bytes:
    """Plain values, NumPy arrays and scalars as bytes. Raises TypeError on anything else."""
    return msgpack.Packer(default=_encode).pack(value)


def unpack(data: bytes) -> object:
    """The value that `pack`, or openpi-client's packer, wrote. Arrays are read-only views of ``data``.

    Raises MessageError on anything that is not such a message, more than `MAX_CONTAINERS` maps and lists, more than
    `MAX_DIMENSIONS` dimensions, or an array of other things than numbers.
    """
    counted = 0

    def count(container: Container) -> Container:
        nonlocal counted
        counted += 1
        if counted > MAX_CONTAINERS:
            raise MessageError(f"message: more than {MAX_CONTAINERS} lists and maps; send numbers as NumPy arrays")
        return container

    try:
        return msgpack.unpackb(
            data,
            object_hook=lambda pairs: _decode(count(pairs)),
            list_hook=count,
            max_ext_len=0,
            max_array_len=min(len(data), 4096),
            max_map_len=64,
        )
    except MessageError:
        raise
    except (ValueError, TypeError, OverflowError, msgpack.exceptions.UnpackException) as error:
        why = str(error) or "nested too deeply"
        raise MessageError(f"message: expected msgpack of plain values and NumPy arrays ({why})") from error


def _encode(value: object) -> dict[bytes, object]:
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic) and value.dtype.kind in _KINDS:
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"message: cannot send {type(value).__name__}; expected plain values and arrays of numbers")


def _decode(pairs: dict) -> dict | np.ndarray | np.generic:
    if b"__ndarray__" in pairs:
        dtype, shape, data = _dtype(pairs), pairs.get(b"shape"), pairs.get(b"data")
        if not (
            isinstance(shape, list)
            and len(shape) <= MAX_DIMENSIONS
            and all(type(size) is int and size >= 0 for size in shape)
        ):
            raise MessageError(f"array: expected at most {MAX_DIMENSIONS} sizes as its shape, got {shape!r:.80}")
        size = math.prod(shape) * dtype.itemsize
        if not isinstance(data, bytes) or len(data) != size:
            held = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
            raise MessageError(f"array: {dtype} of shape {tuple(shape)} is {size} bytes, got {held}")
        return np.frombuffer(data, dtype).reshape(shape)
    if b"__npgeneric__" in pairs:
        data = pairs.get(b"data")
        if not isinstance(data, bool | int | float):
            raise MessageError(f"NumPy scalar: expected a number, got {type(data).__name__}")
        return _dtype(pairs).type(data)
    return pairs


def _dtype(pairs: dict) -> np.dtype:
    name = pairs.get(b"dtype")
    if not isinstance(name, str) or len(name) > 8:
        raise MessageError(f"array: expected the name of a NumPy number type, got {name!r:.80}")
    dtype = np.dtype(name)
    if dtype.kind not in _KINDS or dtype.itemsize > 8:
        raise MessageError(f"array: expected bool, integers or floats of at most 64 bits, got {name!r}")
    return dtype
