"""Random keys for episodes: each use of the simulator has a stream of its own, so no two ever share an episode."""

import zlib

import jax
import jax.numpy as jnp

SPLITS = ("train", "eval", "validation")


def episode_keys(seed: int, split: str, task: str, start: int, count: int) -> jax.Array:
    """Keys (count,) of the episodes start .. start + count - 1 of a task in a split.

    The key of an episode depends on (seed, split, task, its number) alone: never on how many are asked for at a time.
    The split is folded in first, so two splits have different streams for every task and number.
    """
    if split not in SPLITS:
        raise ValueError(f"split: expected one of {SPLITS}, got {split!r}; choose a stream")
    if start < 0 or count < 0:
        raise ValueError(f"episode_keys: expected start >= 0 and count >= 0, got {start} and {count}")
    stream = jax.random.fold_in(jax.random.key(seed), SPLITS.index(split))
    stream = jax.random.fold_in(stream, zlib.crc32(task.encode()))
    return jax.vmap(lambda number: jax.random.fold_in(stream, number))(jnp.arange(start, start + count))
