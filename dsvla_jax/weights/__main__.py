"""Other projects' weights in and ours out:

    python -m dsvla_jax.weights import SRC OUT [--vision SRC2] [--image-size 336]
    python -m dsvla_jax.weights export RUN OUT [--merged] [--dtype bfloat16]

SRC is the folder of a Hugging Face checkpoint with a LLaMA decoder, SRC2 of one with a CLIP vision tower. RUN is a run
folder of train.py.
"""

import sys
from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.policy import load_policy_config
from dsvla_jax.weights.base import import_backbones
from dsvla_jax.weights.export import ExportOptions, export_run
from dsvla_jax.weights.towers import summarize

DTYPES = {"float32": np.float32, "bfloat16": jnp.bfloat16}


def import_command(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    /,
    vision: Path | None = None,
    image_size: int | None = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
    projection: bool = False,
) -> None:
    """Writes the towers of Hugging Face checkpoints to a new folder, as parameters of this project's model.

    Args:
        source: folder with config.json and safetensors of a LLaMA decoder.
        out: the folder to write; it appears whole or not at all.
        vision: folder with config.json and safetensors of a CLIP vision tower.
        image_size: resample the tower's positional embeddings to images of this many pixels.
        dtype: of the numbers on disk; bfloat16 takes half the space and memory.
        projection: keep CLIP's projection into its joint embedding, which LLaMA-Adapter reads.
    """
    towers = import_backbones(source, out, vision, image_size, DTYPES[dtype], projection)
    for name, tower in towers.items():
        print(f"{name}: {tower.size:,} parameters, {tower.config}")
        if tower.unused:
            print(f"{name}: left alone: {summarize(tower.unused)}")
    print(f"written: {out}")


def export_command(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    /,
    merged: bool = False,
    dtype: Literal["float32", "bfloat16"] = "float32",
    shard_gigabytes: float = 2.0,
    language_base: str | None = None,
    vision_base: str | None = None,
) -> None:
    """Writes the newest checkpoint of a run to a new folder, as PEFT and transformers open it.

    Args:
        run: a run folder of train.py.
        out: the folder to write; it appears whole or not at all.
        merged: write whole models with the adapters added to their weights, instead of the adapters alone.
        dtype: of the numbers on disk.
        shard_gigabytes: how large one file of a merged model may be.
        language_base: the model that the language adapters belong to, a folder or a name on the Hub, noted for peft.
        vision_base: the same of the vision adapters.
    """
    bases = {"language": language_base, "vision": vision_base}
    options = ExportOptions(merged, DTYPES[dtype], shard_gigabytes * 1e9, bases)
    config = load_policy_config(run)
    folders = export_run(run, out, config.model, load_tokenizer(run), options)
    print(f"written: {out} ({', '.join(folders)})")


def main() -> None:
    """Runs the command that the arguments name."""
    commands = {"import": import_command, "export": export_command}
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in commands:
        print(__doc__)
        sys.exit(0 if name in ("", "-h", "--help") else 2)
    with fail_with_message():
        tyro.cli(commands[name], args=sys.argv[2:], prog=f"python -m dsvla_jax.weights {name}")


if __name__ == "__main__":
    main()
