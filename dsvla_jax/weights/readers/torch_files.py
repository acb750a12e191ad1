"""Where the tensors of a PyTorch file (.pth, .pt) lie, found without PyTorch and without running what the file says.

The format since PyTorch 1.6: a zip archive, nothing in it compressed, of data.pkl (a pickle in which a tensor is
`_rebuild_tensor_v2(storage, offset, size, stride, ...)` and a storage a persistent id) and data/<key>, the storages'
numbers. TorchScript archives, as OpenAI published CLIP, are the same with modules in place of dicts.
pytorch/pytorch, torch/serialization.py and torch/_utils.py; docs/source/notes/serialization.rst.

A pickle calls what it names. Here no name is looked up: the few that tensors are made with mean functions of this file,
others of known harmless modules mean an empty object, and any other is an error.
"""

import collections
import dataclasses
import math
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from dsvla_jax.weights.stored_tensors import AGAIN, FLOATS, StoredTensor, WeightsError

DTYPES = {"FloatStorage": "F32", "HalfStorage": "F16", "BFloat16Storage": "BF16"}
# What training scripts save beside the parameters. Nothing of it is kept.
IGNORED = ("torch", "__torch__", "argparse", "numpy", "pathlib")
_DAMAGED = (
    zipfile.BadZipFile,
    pickle.UnpicklingError,
    EOFError,
    TypeError,
    ValueError,
    KeyError,
    IndexError,
    AttributeError,
)
SAVE_AGAIN = "save it again with a newer PyTorch: torch.save(torch.load(file, weights_only=True), file)"


class _Ignored:
    """Stands for an object of any class: keeps its attributes and items, does nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        if isinstance(state, Mapping):
            self.__dict__.update(state)

    def append(self, _: object) -> None:
        pass

    def extend(self, _: object) -> None:
        pass

    def __setitem__(self, _: object, __: object) -> None:
        pass


class _Unpickler(pickle.Unpickler):
    """Rebuilds dicts and lists, and a StoredTensor in place of each tensor."""

    def __init__(self, stream: IO[bytes], file: Path, storages: Mapping[str, tuple[int, int]]) -> None:
        super().__init__(stream)
        self._file, self._storages = file, storages

    def find_class(self, module: str, name: str) -> object:
        if module == "collections" and name == "OrderedDict":
            return collections.OrderedDict
        if module == "torch._utils" and name == "_rebuild_tensor_v2":
            return self._tensor
        if module == "torch._utils" and name == "_rebuild_parameter":
            return lambda data, *_: data
        if module == "torch" and name.endswith("Storage"):
            return name
        if module.split(".")[0] in IGNORED:
            return _Ignored
        raise WeightsError(
            f"{self._file}: wants to call {module}.{name}, which no checkpoint needs: nothing was run; "
            "get the file from a source that you trust"
        )

    def persistent_load(self, pid: tuple[object, ...]) -> tuple[str, str]:
        _, kind, key, *_ = pid
        return str(kind), str(key)

    def _tensor(
        self, storage: tuple[str, str], offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: object
    ) -> StoredTensor:
        kind, key = storage
        dtype = DTYPES.get(kind, kind)
        if key not in self._storages:
            raise WeightsError(f"{self._file}: its data/{key} is missing; {AGAIN}")
        begin, end = self._storages[key]
        size = FLOATS[dtype].itemsize if dtype in FLOATS else 1
        contiguous = tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))
        if any(
            length > 1 and found != wanted for length, found, wanted in zip(shape, strides, contiguous, strict=True)
        ):
            dtype = f"a view of {dtype} with strides {strides}"
        begin += offset * size
        return StoredTensor("", self._file, dtype, tuple(shape), begin, min(begin + math.prod(shape) * size, end))


def list_tensors(file: Path) -> dict[str, StoredTensor]:
    """Every tensor of a PyTorch file by its path through dicts and modules, joined by "."; no tensor is read.

    Raises WeightsError where the file is damaged, older than PyTorch 1.6, or names what no checkpoint needs.
    """
    if not file.is_file():
        raise WeightsError(f"{file}: missing; expected a PyTorch checkpoint")
    if not zipfile.is_zipfile(file):
        raise WeightsError(f"{file}: {_no_archive(file)}")
    try:
        with zipfile.ZipFile(file) as archive:
            root = next(name for name in archive.namelist() if name.endswith("/data.pkl")).removesuffix("data.pkl")
            if root + "byteorder" in archive.namelist() and archive.read(root + "byteorder") != b"little":
                raise WeightsError(f"{file}: big-endian numbers are not read; {SAVE_AGAIN}")
            storages = _storages(file, archive, root + "data/")
            with archive.open(root + "data.pkl") as stream:
                content = _Unpickler(stream, file, storages).load()
    except StopIteration:
        raise WeightsError(f"{file}: a zip archive without data.pkl: no PyTorch checkpoint") from None
    except _DAMAGED as error:
        raise WeightsError(f"{file}: not a PyTorch checkpoint, or damaged ({error!r}); {AGAIN}") from error
    tensors: dict[str, StoredTensor] = {}
    _collect(content, (), tensors)
    return tensors


def _no_archive(file: Path) -> str:
    """What a file is that is no zip archive, and what to do about it."""
    with file.open("rb") as stream:
        begin = stream.read(9)
    if begin[:1] == b"\x80":
        return f"written by a PyTorch before 1.6; {SAVE_AGAIN}"
    if begin[8:] == b"{":
        return "a safetensors file, no PyTorch checkpoint; name its folder, which has the config.json, as the source"
    return f"no zip archive: cut short; {AGAIN}"


def _storages(file: Path, archive: zipfile.ZipFile, prefix: str) -> dict[str, tuple[int, int]]:
    """First and last byte of each storage, from the start of the file."""
    places, size = {}, file.stat().st_size
    with file.open("rb") as stream:
        for info in archive.infolist():
            if not info.filename.startswith(prefix):
                continue
            # The local header: 26 fixed bytes, the lengths of name and extra field, these two, then the content.
            stream.seek(info.header_offset + 26)
            lengths = stream.read(4)
            begin = info.header_offset + 30 + sum(int.from_bytes(lengths[i : i + 2], "little") for i in (0, 2))
            if info.compress_type != zipfile.ZIP_STORED or begin + info.file_size > size:
                raise WeightsError(f"{file}: {info.filename} is compressed or cut short; {AGAIN}")
            places[info.filename.removeprefix(prefix)] = begin, begin + info.file_size
    return places


def _collect(value: object, path: tuple[str, ...], tensors: dict[str, StoredTensor]) -> None:
    if isinstance(value, StoredTensor):
        key = ".".join(path)
        tensors[key] = dataclasses.replace(value, key=key)
    elif len(path) > 30:
        return  # an object that contains itself
    elif isinstance(value, Mapping):
        for name, item in value.items():
            _collect(item, (*path, str(name)), tensors)
    elif isinstance(value, _Ignored):
        _collect(vars(value), path, tensors)
