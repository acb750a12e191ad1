"""Write a word-level vocabulary for demonstrations of one's own: python -m data_pipelines.vocabulary FOLDER OUT

It has the words of the task suite and those of the folder's instructions, for configs whose language model starts from
scratch, such as `tiny`. For Open X-Embodiment: python -m data_pipelines.oxe vocabulary OUT.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import tyro

from data_pipelines.episodes import EpisodeReader
from dsvla_jax.command_line import fail_with_message, parse_options
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.sim.tasks import TASKS


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command line."""

    folder: tyro.conf.Positional[Path]
    """Demonstrations."""
    out: tyro.conf.Positional[Path]
    """The folder to write tokenizer.json into."""


def write_vocabulary(out: Path, texts: Iterable[str]) -> None:
    """Writes the words of the task suite and of the texts, and prints how to train with them."""
    suite = [text for task in TASKS.values() for text in task.all_instructions()]
    tokenizer = WordTokenizer(vocabulary([*suite, *texts]))
    out.mkdir(parents=True, exist_ok=True)
    tokenizer.save(out)
    print(f"{out / 'tokenizer.json'}: {tokenizer.vocab_size} tokens; train with")
    print(f"  --tokenizer {out} --model.language.vocab-size {tokenizer.vocab_size}")


if __name__ == "__main__":
    with fail_with_message():
        options = parse_options(Options, prog="python -m data_pipelines.vocabulary", description=__doc__)
        write_vocabulary(options.out, EpisodeReader(options.folder).instructions)
