"""RLBench's pickles without RLBench, and without running anything that is in them.

A pickle may name any function of any installed package and have it called. Here every name that RLBench's files use
stands for an inert `Node`, which only keeps what it was given, and every other name is refused. What a file says is
read from the nodes afterwards: nothing of NumPy or RLBench is called by unpickling.

Names: ``rlbench/demo.py`` and ``rlbench/backend/observation.py`` of stepjam/RLBench and of its forks for PerAct and
PerAct2; NumPy's own helpers for arrays and scalars, under the module names of NumPy 1 and 2.
"""

import io
import pickle
from pathlib import Path

import numpy as np

from dsvla_jax.errors import DataError

_RLBENCH = {
    ("rlbench.demo", "Demo"),
    ("rlbench.backend.observation", "Observation"),
    ("rlbench.backend.observation", "UnimanualObservation"),
    ("rlbench.backend.observation", "UnimanualObservationData"),
    ("rlbench.backend.observation", "BimanualObservation"),
}
_NUMPY = {
    (f"{package}.{module}", name)
    for package in ("numpy.core", "numpy._core")
    for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
}
# How the protocols before 3 write bytes: a text and the name of its encoding, or nothing at all.
_BYTES = {("_codecs", "encode"), ("__builtin__", "bytes")}
KNOWN_NAMES = _RLBENCH | _NUMPY | _BYTES | {("numpy", "ndarray"), ("numpy", "dtype")}

# Kinds and sizes of number that are read: bool, signed, unsigned and floating point, little- or big-endian.
_DTYPES = {"b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"}

# What the unpickler raises on damaged files, by its documentation and by fuzzing it.
_DAMAGE = (
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    ImportError,
    IndexError,
    KeyError,
    MemoryError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
)


class Node:
    """An object of a pickle that was not made: the arguments and the state it would have been made with."""

    name = ""
    args: tuple[object, ...]
    state: object

    def __new__(cls, *args: object) -> "Node":
        """Keeps the arguments."""
        node = super().__new__(cls)
        node.args, node.state = args, None
        return node

    def __init__(self, *args: object) -> None:
        del args

    def __setstate__(self, state: object) -> None:
        """Keeps the state."""
        self.state = state

    def field(self, name: str) -> object:
        """An attribute of the object. Raises KeyError where it has none of that name."""
        if not isinstance(self.state, dict):
            raise KeyError(name)
        return self.state[name]

    def has(self, name: str) -> bool:
        """Whether the object has such an attribute."""
        return isinstance(self.state, dict) and name in self.state


class _Refused(Exception):
    """A pickle names something that RLBench's files have no use for."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> type[Node]:
        """A class that makes nothing. Raises _Refused for a name that RLBench's files have no use for."""
        if (module_name, global_name) not in KNOWN_NAMES:
            raise _Refused(f"{module_name}.{global_name}")
        # A class of its own for every mention: whatever a pickle does to it is forgotten with the file.
        return type("Node", (Node,), {"name": global_name})


def read_pickle(path: Path) -> object:
    """The contents of a pickle as plain Python values and `Node` objects.

    Raises DataError naming the file where it is missing, damaged, or names anything unknown.
    """
    fix = "copy or unpack the data set again, or leave such episodes out with --skip-bad"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(path, "file", "a pickle of RLBench", error.strerror or str(error), fix) from error
    try:
        return _Unpickler(io.BytesIO(data)).load()
    except _Refused as error:
        safe = "it was not read further, and nothing in it was run; do not trust where it came from"
        raise DataError(path, "pickle", "only RLBench's own classes and NumPy arrays", str(error), safe) from error
    except _DAMAGE as error:
        got = f"{len(data)} bytes that are none ({type(error).__name__}: {error})"
        raise DataError(path, "pickle", "a whole pickle", got, fix) from error


def to_array(value: object) -> np.ndarray:
    """Numbers of a pickle, plain or NumPy's, as an array. Raises ValueError where they are neither."""
    if not isinstance(value, Node):
        if isinstance(value, list | tuple) and any(isinstance(item, Node) for item in value):
            value = [to_array(item) for item in value]
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise ValueError(f"{str(value)[:40]!r} is not a number")
        return array
    match value.name, value.args, value.state:
        case "_reconstruct", _, (_, tuple(shape), Node() as dtype, fortran, data):
            return _array(data, dtype, shape, "F" if fortran else "C")
        case "_frombuffer", (data, Node() as dtype, tuple(shape), str(order)), _:
            return _array(data, dtype, shape, order)
        case "scalar", (Node() as dtype, data), _:
            return _array(data, dtype, (), "C")
    raise ValueError(f"a pickled {value.name} is not an array")


def _array(data: object, dtype: Node, shape: tuple[int, ...], order: str) -> np.ndarray:
    match data:
        case Node(name="encode", args=(str() as text, "latin1")):
            data = text.encode("latin1")
        case Node(name="bytes", args=()):
            data = b""
    if not isinstance(data, bytes | bytearray):
        raise ValueError(f"an array of {type(data).__name__}")
    code = dtype.args[0] if dtype.name == "dtype" and dtype.args else None
    if not isinstance(code, str) or code not in _DTYPES:
        raise ValueError(f"an array of {dtype.args[:1] if dtype.args else dtype.name}")
    byte_order = dtype.state[1] if isinstance(dtype.state, tuple) and len(dtype.state) > 1 else "="
    kind = np.dtype(code).newbyteorder(">" if byte_order == ">" else "<")
    array = np.frombuffer(data, kind).reshape(shape, order="F" if order == "F" else "C")
    return array.astype(kind.newbyteorder("="))
