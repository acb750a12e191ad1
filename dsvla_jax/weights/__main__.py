"""Other projects' weights in and ours out:

    python -m dsvla_jax.weights import SRC OUT [--vision SRC2] [--adapter FILE] [...]
    python -m dsvla_jax.weights export RUN OUT [--merged] [--dtype bfloat16]

SRC has a LLaMA decoder: a Hugging Face folder, Meta's, or a GGUF file. SRC2 has a CLIP vision tower: a Hugging Face
folder, or OpenAI's file. FILE has what LLaMA-Adapter's training adds to both. RUN is a run folder of train.py.
docs/weights.md says more.
"""

import sys
from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import fail_with_message, require_each_option_once
from dsvla_jax.model.config import VisualPromptConfig
from dsvla_jax.policy import load_policy_config, load_vocabulary
from dsvla_jax.weights.backbones import import_backbones
from dsvla_jax.weights.export import ExportOptions, export_run
from dsvla_jax.weights.towers import summarize

DTYPES = {"float32": np.dtype(np.float32), "bfloat16": np.dtype(jnp.bfloat16)}


def import_command(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    /,
    vision: Path | None = None,
    image_size: int | None = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
    projection: bool = False,
    adapter: Path | None = None,
    adapter_heads: int = VisualPromptConfig().heads,
) -> None:
    """Writes the towers of checkpoints to a new folder, as parameters of this project's model.

    Args:
        source: a LLaMA decoder: a Hugging Face folder (config.json and safetensors), Meta's (params.json and
            consolidated.00.pth), or a GGUF file.
        out: the folder to write; it appears whole or not at all.
        vision: a CLIP vision tower: a Hugging Face folder, or OpenAI's file (.pt).
        image_size: resample the tower's positional embeddings to images of this many pixels.
        dtype: of the numbers on disk; bfloat16 takes half the space and memory.
        projection: keep CLIP's projection into its joint embedding, which LLaMA-Adapter reads.
        adapter: a PyTorch file of LLaMA-Adapter's projection, gates and adapters, as ManipLLM and 3DS-VLA keep them.
        adapter_heads: attention heads of the adapter's visual blocks, which no file says.
    """
    towers = import_backbones(
        source, out, vision, image_size, DTYPES[dtype], projection, adapter=adapter, adapter_heads=adapter_heads
    )
    for name, tower in towers.items():
        print(f"{name}: {tower.size:,} parameters, {tower.config}")
        for note in tower.notes:
            print(f"{name}: {note}")
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
    folders = export_run(run, out, config.model, load_vocabulary(run, config), options)
    print(f"written: {out} ({', '.join(folders)})")


def main() -> None:
    """Runs the command that the arguments name."""
    commands = {"import": import_command, "export": export_command}
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in commands:
        print(__doc__)
        if name in ("", "-h", "--help"):
            sys.exit(0)
        print(f"error: unknown command {name!r}: expected {' or '.join(commands)}", file=sys.stderr)
        sys.exit(2)
    with fail_with_message():
        require_each_option_once(sys.argv[2:])
        tyro.cli(commands[name], args=sys.argv[2:], prog=f"python -m dsvla_jax.weights {name}")


if __name__ == "__main__":
    main()
