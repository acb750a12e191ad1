"""The vocabulary of a run: the words of the task suite, or a language model's."""

from functools import cache

from dsvla_jax.encoding.pretrained_tokenizers import fits_rows, load_tokenizer
from dsvla_jax.encoding.text import Tokenizer, WordTokenizer, vocabulary
from dsvla_jax.errors import UserError
from dsvla_jax.sim.tasks import TASKS


@cache
def suite_tokenizer() -> WordTokenizer:
    """The word-level vocabulary of every instruction of the task suite."""
    return WordTokenizer(vocabulary(text for task in TASKS.values() for text in task.all_instructions()))


def tokenizer_of(folder: str, rows: int | None) -> Tokenizer:
    """Loads a run's vocabulary. Raises UserError if it does not fit the language model.

    folder: of the vocabulary; empty for the words of the task suite. rows: of the language model's embedding;
    None where there is none.
    """
    tokenizer = load_tokenizer(folder) if folder else suite_tokenizer()
    if rows is not None and not fits_rows(tokenizer, rows):
        raise UserError(
            f"tokenizer: {folder or 'the words of the task suite'} has {tokenizer.vocab_size} tokens, "
            f"model.language.vocab_size is {rows}; they must be of one language model"
        )
    return tokenizer
