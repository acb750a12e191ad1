"""The folder of imported weights, which is written in pieces and read in shards, so that neither needs them whole.

description.json    what must be known to use them; written last
params/             an orbax checkpoint of a PyTree, its arrays in zarr chunks
"""

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import cast

import jax
import numpy as np
import orbax.checkpoint as ocp
import tensorstore as ts
from flax import traverse_util
from jax.sharding import SingleDeviceSharding

from dsvla_jax.checkpoints.storage import SEPARATOR, CheckpointError, PyTree, require_same_shapes, require_writable_path
from dsvla_jax.files import whole_folder
from dsvla_jax.json_values import Json

DESCRIPTION, PARAMS = "description.json", "params"
# Numbers along each of a chunk's two sides, 8 MB of bfloat16. Whoever needs a part of a chunk reads all of it.
CHUNK = 2048


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder beside it to write to: it appears when the block ends, and not at all where it raises or is killed.

    Raises CheckpointError where there is one already.
    """
    if folder.exists():
        raise CheckpointError(f"{folder} exists already; remove it, or choose another folder")
    with whole_folder(folder) as partial:
        yield partial


@contextlib.contextmanager
def create_weights(
    folder: Path, leaves: Mapping[str, jax.ShapeDtypeStruct], description: Mapping[str, Json]
) -> Iterator[dict[str, ts.TensorStore]]:
    """A new folder of weights, see `new_folder`.

    leaves: by path ("language/layers/q/kernel"). Yields an array on disk for each: ``arrays[path][index] = values``
    writes.
    """
    require_writable_path(folder, SEPARATOR)
    with new_folder(folder) as partial:
        # Orbax writes the tree, with one number in each array; the arrays are then made anew in their real sizes.
        tree = traverse_util.unflatten_dict(
            {path: np.zeros((1,) * leaf.ndim, leaf.dtype) for path, leaf in leaves.items()}, sep="/"
        )
        (partial / PARAMS).mkdir()
        handler = ocp.PyTreeCheckpointHandler(use_ocdbt=False)
        handler.save(partial / PARAMS, args=ocp.args.PyTreeSave(tree))  # pyright: ignore[reportArgumentType]
        handler.close()
        yield {path: _create_array(partial, path, leaf) for path, leaf in leaves.items()}
        (partial / DESCRIPTION).write_text(json.dumps(description, indent=2) + "\n")


def _create_array(folder: Path, path: str, leaf: jax.ShapeDtypeStruct) -> ts.TensorStore:
    chunks = [1] * (leaf.ndim - 2) + [min(size, CHUNK) for size in leaf.shape[-2:]]
    metadata = {"chunks": chunks, "compressor": {"id": "zstd", "level": 1}}
    spec = _spec(folder / PARAMS / path.replace("/", ".")) | {"metadata": metadata}
    return ts.open(spec, create=True, delete_existing=True, shape=leaf.shape, dtype=ts.dtype(leaf.dtype)).result()


def _spec(array: Path) -> dict[str, Json]:
    return {"driver": "zarr", "kvstore": {"driver": "file", "path": f"{array.absolute()}/"}}


def describe_weights(folder: Path) -> dict[str, Json]:
    """The description of a folder that `create_weights` made. Raises CheckpointError where it made none here."""
    file = folder / DESCRIPTION
    if not file.is_file():
        raise CheckpointError(
            f"{folder}: no imported weights here; write them with: python -m dsvla_jax.weights import"
        )
    try:
        return json.loads(file.read_text())
    except ValueError as error:
        raise CheckpointError(f"{file}: not JSON ({error}); import the weights again") from error


def _keep(path: str, array: jax.Array) -> dict[str, jax.Array]:
    return {path: array}


def restore_weights(
    folder: Path, like: PyTree, convert: Callable[[str, jax.Array], dict[str, jax.Array]] = _keep
) -> PyTree:
    """The parameters of a folder, with the structure, shapes, dtypes and shardings of ``like``.

    A device is given its shard and no more. A host reads the chunks of its own devices' shards, an array at a time.
    convert: from the path and values of each array to what is kept of it, by path.
    Raises CheckpointError where structure or shapes differ.
    """
    stored = {
        array.name: ts.open(_spec(array), open=True).result() for array in (folder / PARAMS).iterdir() if array.is_dir()
    }
    require_same_shapes(traverse_util.unflatten_dict(stored, sep="."), like, folder)
    restored: dict[str, jax.Array] = {}
    leaves = cast(dict[str, jax.ShapeDtypeStruct], traverse_util.flatten_dict(like, sep="/"))
    for path, leaf in leaves.items():
        restored |= convert(path, _restore_array(stored[path.replace("/", ".")], leaf))
    return traverse_util.unflatten_dict(restored, sep="/")


def _restore_array(store: ts.TensorStore, like: jax.ShapeDtypeStruct) -> jax.Array:
    sharding = like.sharding or SingleDeviceSharding(jax.devices()[0])
    values = ts.cast(store, ts.dtype(like.dtype))
    return jax.make_array_from_callback(like.shape, sharding, lambda index: values[index].read().result())
