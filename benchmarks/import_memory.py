"""An import's peak memory is below 1.3 x the largest shard + 1 GiB, and a host reads its own part only (10 minutes).

Usage: python -m benchmarks.import_memory [--layers 24] [--dtype bfloat16]

Writes a checkpoint of a LLaMA decoder in random bfloat16 shards (3.5 GB with 24 layers), imports it on the command line
and restores the result as two processes, each with one half of every matrix: at most that half, the half of the
largest array and 1 GiB. Peaks are the kernel's (maximum resident set), which count mapped files too. Needs twice the
checkpoint's size on disk, in --folder, and leaves nothing.
"""

import dataclasses
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.weights.readers.hugging_face import LLAMA_NAMES, LM_HEAD
from dsvla_jax.weights.readers.hugging_face_config import read_language_config
from dsvla_jax.weights.towers import tower_shapes

GIB = 2**30

RESTORE = """
import sys
import jax
import numpy as np
from pathlib import Path
from jax.sharding import AxisType, NamedSharding, PartitionSpec
jax.distributed.initialize(sys.argv[2], 2, int(sys.argv[3]))
from dsvla_jax.weights.backbones import load_backbones, backbone_shapes
mesh = jax.make_mesh((2,), ("fsdp",), axis_types=(AxisType.Auto,))

def sharded(leaf):
    axes = [None] * leaf.ndim
    if leaf.ndim > 1:
        axes[-1] = "fsdp"
    return jax.ShapeDtypeStruct(leaf.shape, np.dtype({dtype!r}), sharding=NamedSharding(mesh, PartitionSpec(*axes)))

like = jax.tree.map(sharded, backbone_shapes(Path(sys.argv[1])))
params = load_backbones(Path(sys.argv[1]), like)
held = sum(shard.data.nbytes for leaf in jax.tree.leaves(params) for shard in leaf.addressable_shards)
print("held", held)
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """The checkpoint to import. folder: where there is room for it twice; the default is that of temporary files."""

    layers: int = 24
    width: int = 2048
    ffn: int = 8192
    vocab_size: int = 32000
    shards: int = 7
    dtype: Literal["bfloat16", "float32"] = "bfloat16"
    folder: Path | None = None


def write_source(folder: Path, options: Options) -> int:
    """A sharded Hugging Face folder; returns the bytes of its largest shard."""
    folder.mkdir()
    config = {
        "model_type": "llama",
        "hidden_size": options.width,
        "num_hidden_layers": options.layers,
        "intermediate_size": options.ffn,
        "num_attention_heads": options.width // 64,
        "vocab_size": options.vocab_size,
    }
    (folder / "config.json").write_text(json.dumps(config))
    shapes = tower_shapes(read_language_config(folder))
    language = (options.vocab_size, options.width)
    tensors: dict[str, tuple[int, ...]] = {"model." + LLAMA_NAMES["embedding"]: language, LM_HEAD: language}
    tensors["model.norm.weight"] = (options.width,)
    for ours, theirs in LLAMA_NAMES.items():
        if ours.startswith("layers/") and ours in shapes:
            shape = shapes[ours][:0:-1]
            tensors |= {f"model.{theirs.format(index)}": shape for index in range(options.layers)}

    values = np.random.default_rng(0).standard_normal(2**22, np.float32).astype(jnp.bfloat16)
    names, weight_map, largest = list(tensors), {}, 0
    for index in range(options.shards):
        own = names[index :: options.shards]
        file = folder / f"model-{index + 1:05d}-of-{options.shards:05d}.safetensors"
        header, offset = {}, 0
        for name in own:
            end = offset + 2 * int(np.prod(tensors[name]))
            header[name] = {"dtype": "BF16", "shape": tensors[name], "data_offsets": [offset, end]}
            offset = end
        text = json.dumps(header).encode()
        with file.open("wb") as stream:
            stream.write(len(text).to_bytes(8, "little") + text)
            for name in own:
                count = int(np.prod(tensors[name]))
                for start in range(0, count, len(values)):
                    stream.write(values[: min(len(values), count - start)].tobytes())
        weight_map |= dict.fromkeys(own, file.name)
        largest = max(largest, file.stat().st_size)
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    return largest


def run(*commands: list[str]) -> tuple[list[int], list[str]]:
    """Runs commands at the same time; the peak resident bytes of each, and what it printed."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) for command in commands]
    peaks, outputs = [], []
    for process, command in zip(processes, commands, strict=True):
        assert process.stdout is not None
        outputs.append(process.stdout.read())
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            sys.exit(f"failed: {' '.join(command)[:200]}")
        peaks.append(usage.ru_maxrss * 1024)
    return peaks, outputs


def main(options: Options) -> None:
    root = Path(tempfile.mkdtemp(prefix="import_memory_", dir=options.folder))
    try:
        measure(root, options)
    finally:
        shutil.rmtree(root)


def measure(root: Path, options: Options) -> None:
    source, out = root / "source", root / "out"
    largest = write_source(source, options)
    total = sum(file.stat().st_size for file in source.iterdir())
    limit = 1.3 * largest + GIB
    print(f"source: {total / GIB:.2f} GiB in {options.shards} shards, the largest {largest / GIB:.2f} GiB")
    (idle,), _ = run([sys.executable, "-c", "import dsvla_jax.weights.backbones"])
    started = time.monotonic()
    command = ["import", str(source), str(out), "--dtype", options.dtype]
    (peak,), _ = run([sys.executable, "-m", "dsvla_jax.weights", *command])
    seconds = time.monotonic() - started
    print(f"import to {options.dtype}: {seconds:.0f} s, peak {peak / GIB:.2f} GiB, limit {limit / GIB:.2f} GiB")
    print(f"of these before anything is read: {idle / GIB:.2f} GiB")

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    code = RESTORE.format(dtype=options.dtype)
    peaks, outputs = run(*([sys.executable, "-c", code, str(out), address, str(index)] for index in range(2)))
    size = total * (2 if options.dtype == "float32" else 1)
    for index, (host_peak, output) in enumerate(zip(peaks, outputs, strict=True)):
        held = int(output.split()[-1])
        print(f"restore, host {index} of 2: holds {held / GIB:.2f} of {size / GIB:.2f} GiB, peak {host_peak / GIB:.2f}")
    too_much = [f"import {peak / GIB:.2f} GiB"] * (peak >= limit)
    # Arrays are read one at a time.
    own = (size + size * options.width * options.ffn * options.layers * 2 / total) / 2
    too_much += [f"host {index}" for index, host_peak in enumerate(peaks) if host_peak >= own + GIB]
    if too_much:
        sys.exit(f"too much memory: {', '.join(too_much)}")


if __name__ == "__main__":
    with fail_with_message():
        main(tyro.cli(Options, description=__doc__))
