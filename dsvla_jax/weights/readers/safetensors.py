"""Reading a folder of safetensors files a tensor at a time, without the framework that wrote it.

The format: 8 bytes n (little-endian), n bytes of JSON {name: {dtype, shape, data_offsets}}, the tensors' bytes (offsets
count from behind the JSON). A checkpoint in several files has an index, {"weight_map": {name: file}}.
https://github.com/huggingface/safetensors (README, "Format").
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import cast

from dsvla_jax.json_values import Json
from dsvla_jax.weights.stored_tensors import AGAIN, StoredTensor, WeightsError

INDEX, SINGLE = "model.safetensors.index.json", "model.safetensors"


def read_json(file: Path) -> dict[str, Json]:
    """A JSON object. Raises WeightsError naming the file where it is missing or something else."""
    if file.parent.is_file():
        raise WeightsError(f"{file.parent}: a file; expected the folder of a Hugging Face checkpoint, which it lies in")
    if not file.is_file():
        raise WeightsError(f"{file}: missing; expected the folder of a Hugging Face checkpoint")
    try:
        content = json.loads(file.read_bytes())
    except ValueError as error:
        raise WeightsError(f"{file}: not JSON ({error}): the file is damaged; {AGAIN}") from error
    if not isinstance(content, dict):
        raise WeightsError(f"{file}: expected a JSON object, found {type(content).__name__}; {AGAIN}")
    return content


def list_tensors(folder: Path) -> dict[str, StoredTensor]:
    """Every tensor of a checkpoint, from the headers of its one file or its shards; no tensor is read."""
    file = folder / SINGLE
    if (folder / INDEX).is_file():
        if file.is_file():
            raise WeightsError(f"{folder}: holds two models, {SINGLE} and {INDEX} with its shards; keep one of them")
        return _list_shards(folder)
    if file.is_file():
        return _list_file(file)
    others = sorted(path.name for path in folder.glob("*.safetensors"))
    if not others:
        raise WeightsError(
            f"{folder}: holds neither {SINGLE} nor {INDEX}; convert other formats with transformers' "
            "save_pretrained(..., safe_serialization=True)"
        )
    raise WeightsError(f"{folder / INDEX}: missing, so it is unknown whether {', '.join(others)} is all; {AGAIN}")


def _list_shards(folder: Path) -> dict[str, StoredTensor]:
    index = folder / INDEX
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, Mapping) or not all(isinstance(name, str) for name in weight_map.values()):
        raise WeightsError(f"{index}: expected a weight_map of names to files; {AGAIN}")
    files = cast(Mapping[str, str], weight_map)
    tensors: dict[str, StoredTensor] = {}
    for name in sorted(set(files.values())):
        shard = folder / name
        if shard.name != name or not shard.is_file():
            raise WeightsError(f"{shard}: this shard is missing, {index.name} names it; {AGAIN}")
        more = _list_file(shard)
        if twice := sorted(tensors.keys() & more.keys()):
            raise WeightsError(f"{shard}: {twice[0]} is in {tensors[twice[0]].file.name} already; {AGAIN}")
        tensors |= more
    for key, name in files.items():
        if key not in tensors or tensors[key].file.name != name:
            raise WeightsError(f"{folder / name}: {key} is not in it, though {index.name} says so; {AGAIN}")
    return tensors


def _list_file(file: Path) -> dict[str, StoredTensor]:
    size = file.stat().st_size
    with file.open("rb") as stream:
        prefix = stream.read(8)
        length = int.from_bytes(prefix, "little")
        if len(prefix) < 8 or 8 + length > size:
            raise WeightsError(
                f"{file}: {size} bytes, but its header alone should have {8 + length}: cut short or not a "
                f"safetensors file; {AGAIN}"
            )
        try:
            header = json.loads(stream.read(length))
            header.pop("__metadata__", None)
            tensors = {
                key: StoredTensor(
                    key,
                    file,
                    str(entry["dtype"]),
                    tuple(map(int, entry["shape"])),
                    *(8 + length + int(offset) for offset in entry["data_offsets"]),
                )
                for key, entry in header.items()
            }
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise WeightsError(f"{file}: its header is not that of a safetensors file ({error!r}); {AGAIN}") from error
    for tensor in tensors.values():
        if not 8 + length <= tensor.begin <= tensor.end:
            raise WeightsError(f"{file}: {tensor.key}: impossible offsets in the header; {AGAIN}")
        if tensor.end > size:
            raise WeightsError(
                f"{file}: {tensor.key}: ends at byte {tensor.end}, the file has {size}: cut short; {AGAIN}"
            )
    return tensors
