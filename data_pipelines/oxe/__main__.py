"""Open X-Embodiment data on the command line: what there is, whether it is whole, statistics, words, and fixtures.

python -m data_pipelines.oxe list [NAME ...]
python -m data_pipelines.oxe prepare --folder data/oxe --mixture bridge_dataset fractal20220817_data=0.5
python -m data_pipelines.oxe vocabulary words/bridge --folder data/oxe --mixture bridge_dataset
python -m data_pipelines.oxe fixtures data/oxe_fixtures --datasets bridge_dataset viola
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from data_pipelines.oxe.fixtures.write import write_fixtures
from data_pipelines.oxe.mixture import MixtureSource, describe_dataset
from data_pipelines.oxe.registry import DATASETS, MIXTURES, get_dataset
from data_pipelines.oxe.scale import MixtureScale
from data_pipelines.vocabulary import write_vocabulary
from dsvla_jax.command_line import fail_with_message
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.ranges import at_least, require


def list_(names: tyro.conf.Positional[tuple[str, ...]] = ()) -> None:
    """Names all datasets and mixtures; with names, prints what is known of those datasets.

    Args:
        names: datasets.
    """
    for name in names:
        dataset = get_dataset(name)
        print(f"{name}: {dataset.source}")
        print(f"  {dataset.hz:g} Hz, {dataset.encoding.replace('_', ' ')}, {len(dataset.arms)} arm(s)", end=", ")
        print("pose recorded" if dataset.has_pose else "no pose", f"pictures {dict(dataset.images)}", sep=", ")
        for note in dataset.notes:
            print(f"  - {note}")
    if not names:
        print(f"{len(DATASETS)} datasets:", *sorted(DATASETS), sep="\n  ")
        print("mixtures:", *(f"{name} ({len(weights)})" for name, weights in MIXTURES.items()), sep="\n  ")


def prepare(config: Annotated[OxeConfig, tyro.conf.arg(name="")], seed: int = 0) -> None:
    """Reads every record of a mixture once: verifies checksums and columns, and keeps index and statistics.

    Args:
        config: the mixture, as training takes it.
        seed: of the order.
    """
    require(seed >= 0, "seed", at_least(0), seed)
    source = MixtureSource(config, seed)
    table = Table("dataset", "episodes", "samples", "share", "left out", "MB a window")
    for item, share in zip(source.datasets, source.shares, strict=True):
        index = item.index
        megabytes = f"{2 * config.window * index.bytes / 1e6:.0f}"
        numbers = (
            f"{len(index.samples):,}",
            f"{index.num_samples:,}",
            f"{100 * share:.2f} %",
            str(len(index.left_out)),
        )
        table.add_row(item.dataset.name, *numbers, megabytes)
    Console().print(table)
    for item in source.datasets:
        print(describe_dataset(item))
    for where, why in source.left_out:
        print(f"left out: {where}: {why}")
    if config.target == "relative":
        scale = MixtureScale(source.datasets, source.shares).scale
        print("displacement from", np.round(scale.low, 4), "to", np.round(scale.high, 4), "(metres and radians)")


def vocabulary(out: tyro.conf.Positional[Path], config: Annotated[OxeConfig, tyro.conf.arg(name="")]) -> None:
    """Writes a word-level vocabulary of a mixture's instructions, for configs whose language model starts from scratch.

    Args:
        out: the folder to write tokenizer.json into.
        config: the mixture, as training takes it.
    """
    write_vocabulary(out, MixtureSource(config, seed=0).words)


def fixtures(
    folder: tyro.conf.Positional[Path], datasets: tuple[str, ...] = (), episodes: int = 16, steps: int = 12
) -> None:
    """Writes small builds with known motions, for a try without a download.

    Args:
        folder: where to.
        datasets: which; all if none are named.
        episodes: of each.
        steps: of the shortest episode.
    """
    require(episodes > 0, "episodes", at_least(1), episodes)
    require(steps > 1, "steps", at_least(2), steps)
    names = [get_dataset(name).name for name in datasets] or sorted(DATASETS)
    write_fixtures(folder, names, episodes, steps)
    print(f"{len(names)} builds in {folder}")


if __name__ == "__main__":
    with fail_with_message():
        commands: dict[str, Callable[..., None]] = {
            "list": list_,
            "prepare": prepare,
            "vocabulary": vocabulary,
            "fixtures": fixtures,
        }
        if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
            print(__doc__)
            sys.exit(0 if len(sys.argv) > 1 else 2)
        tyro.extras.subcommand_cli_from_dict(commands, prog="python -m data_pipelines.oxe")
