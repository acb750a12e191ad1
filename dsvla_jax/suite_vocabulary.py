"""The words of the task suite."""

from functools import cache

from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.sim.tasks import TASKS


@cache
def suite_tokenizer() -> WordTokenizer:
    """The word-level vocabulary of every instruction of the task suite."""
    return WordTokenizer(vocabulary(text for task in TASKS.values() for text in task.all_instructions()))
