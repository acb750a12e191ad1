"""Other projects' weights: python -m dsvla_jax.weights import SRC OUT [--vision SRC2] [--image-size 336]

SRC is the folder of a Hugging Face checkpoint with a LLaMA decoder, SRC2 of one with a CLIP vision tower.
"""

import sys
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.weights.base import import_backbones
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
        size = sum(leaf.size for leaf in jax.tree.leaves(tower.params))
        print(f"{name}: {size:,} parameters, {tower.config}")
        if tower.unused:
            print(f"{name}: left alone: {summarize(tower.unused)}")
    print(f"written: {out}")


def main() -> None:
    """Runs the command that the arguments name."""
    if sys.argv[1:2] != ["import"]:
        print(__doc__)
        sys.exit(0 if sys.argv[1:2] in ([], ["-h"], ["--help"]) else 2)
    with fail_with_message():
        tyro.cli(import_command, args=sys.argv[2:], prog="python -m dsvla_jax.weights import")


if __name__ == "__main__":
    main()
