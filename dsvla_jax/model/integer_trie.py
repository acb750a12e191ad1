"""How one number of the answer is read off the language model, whichever tokens its integers are made of.

The tokens of a slot's integers form a tree. At its root, and at every token after which more than one may follow, the
model has to be asked; where only one may follow there is nothing to ask. All of a tree's tokens are read in one pass,
each seeing only those before it on its own path, which gives the exact probability of every integer at once: the
product of the choices on its path. Where each integer is one token, the tree is its root, and costs no token at all.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dsvla_jax.encoding.grammar import NumberSlot, Tokens
from dsvla_jax.types import Array


@struct.dataclass
class Branches:
    """The tokens of a tree that the model reads, without the root: F of them.

    tokens: int32 (F,). depths: int32 (F,), 1 for a token after the root. sees: bool (F, F), itself and its ancestors.
    """

    tokens: np.ndarray | Array
    depths: np.ndarray | Array
    sees: np.ndarray | Array


@struct.dataclass
class Numbers:
    """N integers and how they are written. All arrays may have further rows, which stand for no integer.

    values: int32 (N,), ascending by one. tokens: int32 (N, W). lengths: int32 (N,), how many of the tokens count; 0 in
    rows that are no integer.
    """

    values: np.ndarray | Array
    tokens: np.ndarray | Array
    lengths: np.ndarray | Array


@struct.dataclass
class Choices:
    """What may follow at the root and at each of the F branches of a tree, and which choices make each integer.

    tokens: int32 (U,), the tokens to compare. goes_on, ends: bool (1 + F, U), those that continue a number there, and
    those that show that it is over. paths: int32 (N, M), the choices that make an integer: node * (U + 1) + column,
    column U standing for the end, and (1 + F) * (U + 1) for none.
    """

    tokens: np.ndarray | Array
    goes_on: np.ndarray | Array
    ends: np.ndarray | Array
    paths: np.ndarray | Array


@struct.dataclass
class IntegerTrie:
    """How the integers of one slot are read."""

    branches: Branches
    choices: Choices
    numbers: Numbers


def integer_trie(slot: NumberSlot) -> IntegerTrie:
    """The tree of a slot's integers."""
    numbers = set(slot.tokens)
    children: dict[Tokens, set[int]] = {}
    for tokens in slot.tokens:
        for place, token in enumerate(tokens):
            children.setdefault(tokens[:place], set()).add(token)

    def choices(path: Tokens) -> int:
        return len(children.get(path, ())) + (path in numbers)

    asked = [path for path in children if path and choices(path) > 1]
    # With those on the way to them, shorter ones first.
    read = sorted({path[:end] for path in asked for end in range(1, len(path) + 1)}, key=lambda path: (len(path), path))
    node = {path: number for number, path in enumerate([(), *read])}
    open_ended = any(path in numbers for path in node)
    columns = sorted({token for path in node for token in children[path]} | (set(slot.ends) if open_ended else set()))
    column = {token: number for number, token in enumerate(columns)}
    goes_on = np.zeros((len(node), len(columns)), bool)
    ends = np.zeros_like(goes_on)
    for path, number in node.items():
        goes_on[number, [column[token] for token in children[path]]] = True
        if path in numbers:
            ends[number, [column[token] for token in slot.ends]] = True
    width = len(columns) + 1
    paths = []
    for tokens in slot.tokens:
        steps = [node[tokens[:p]] * width + column[t] for p, t in enumerate(tokens) if tokens[:p] in node]
        paths.append(steps + ([node[tokens] * width + width - 1] if tokens in node else []))
    sees = [[below[: len(above)] == above for above in read] for below in read]
    return IntegerTrie(
        Branches(
            tokens=np.array([path[-1] for path in read], np.int32),
            depths=np.array([len(path) for path in read], np.int32),
            sees=np.array(sees, bool).reshape(len(read), len(read)),
        ),
        Choices(
            tokens=np.array(columns, np.int32), goes_on=goes_on, ends=ends, paths=_rectangle(paths, len(node) * width)
        ),
        Numbers(
            values=np.array(slot.values, np.int32),
            tokens=_rectangle(slot.tokens, 0),
            lengths=np.array([len(tokens) for tokens in slot.tokens], np.int32),
        ),
    )


def stack_numbers(group: list[Numbers]) -> Numbers:
    """Numbers of several slots in arrays of one shape, with an axis in front."""
    count, width = (max(numbers.tokens.shape[axis] for numbers in group) for axis in (0, 1))
    leaves = [(numbers.values, numbers.tokens, numbers.lengths) for numbers in group]
    return Numbers(*(np.stack([_padded(leaf, count, width) for leaf in same]) for same in zip(*leaves, strict=True)))


def stack_choices(group: list[Choices]) -> Choices:
    """Choices over trees with equally many branches in arrays of one shape, with an axis in front."""
    width = max(len(choices.tokens) for choices in group)
    count, steps = (max(choices.paths.shape[axis] for choices in group) for axis in (0, 1))
    padded = []
    for choices in group:
        nodes, old = choices.goes_on.shape
        # A choice's number counts the columns of the nodes before it, of which there are more now.
        node, column = np.divmod(np.asarray(choices.paths), old + 1)
        paths = node * (width + 1) + np.where((column == old) & (node < nodes), width, column)
        padded.append(
            (
                _padded(choices.tokens, width),
                _padded(choices.goes_on, nodes, width),
                _padded(choices.ends, nodes, width),
                _padded(paths, count, steps, filling=nodes * (width + 1)),
            )
        )
    return Choices(*(np.stack(leaves) for leaves in zip(*padded, strict=True)))


def log_probabilities(logits: Array, choices: Choices) -> Array:
    """Logits (B, 1 + F, U) of a tree's tokens -> float32 (B, N), the log-probability of every integer.

    Only what the grammar admits is considered, at every token. Rows that are no integer get 0.
    """
    admitted = jnp.asarray(choices.goes_on) | jnp.asarray(choices.ends)
    choice = jax.nn.log_softmax(jnp.where(admitted, logits, -jnp.inf), axis=-1)
    end = jax.nn.logsumexp(jnp.where(choices.ends, choice, -jnp.inf), axis=-1, keepdims=True)
    flat = jnp.concatenate([choice, end], axis=-1).reshape(len(logits), -1)
    flat = jnp.pad(flat, ((0, 0), (0, 1)))
    return flat[:, jnp.asarray(choices.paths)].sum(axis=-1)


def _rectangle(rows: Sequence[Sequence[int]], filling: int) -> np.ndarray:
    array = np.full((len(rows), max(map(len, rows))), filling, np.int32)
    for row, values in zip(array, rows, strict=True):
        row[: len(values)] = values
    return array


def _padded(array: np.ndarray | Array, *shape: int, filling: int = 0) -> np.ndarray:
    array = np.asarray(array)
    more = [(0, size - old) for size, old in zip(shape, array.shape, strict=False)]
    return np.pad(array, more, constant_values=filling)
