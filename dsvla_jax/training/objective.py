"""The imitation objective: cross-entropy on the tokens of the answer, and on nothing else."""

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.types import Array


def target_distributions(number_values: np.ndarray, sigma: float) -> np.ndarray | None:
    """Row t is the distribution to learn when the target token is t: float32 (V, V).

    One-hot for words. For the token of an integer, a Gaussian over the integers around it, `sigma` bins wide, which
    tells the model that neighbouring bins are nearly right. `sigma` 0 is the paper's one-hot everywhere, and None: with
    the vocabulary of a real language model the table would take gigabytes.

    number_values: float32 (V,), NaN where a token is no integer.
    """
    if sigma <= 0:
        return None
    targets = np.eye(len(number_values), dtype=np.float32)
    numbers = np.flatnonzero(~np.isnan(number_values))
    values = number_values[numbers].astype(np.float64)
    weights = np.exp(-0.5 * ((values[:, None] - values[None, :]) / sigma) ** 2)
    targets[np.ix_(numbers, numbers)] = weights / weights.sum(1, keepdims=True)
    return targets


def answer_counts(answer_mask: Array, soft_mask: Array) -> tuple[Array, Array]:
    """How many tokens of bool (B, T) masks `answer_loss` takes means over: of answers, and of bins in them; 1 for 0."""
    answer = answer_mask[:, 1:]
    return jnp.maximum(answer.sum(), 1), jnp.maximum((soft_mask[:, 1:] & answer).sum(), 1)


def answer_loss(
    logits: Array,
    text_tokens: Array,
    answer_mask: Array,
    soft_mask: Array,
    targets: Array | None,
    counts: tuple[Array, Array] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Mean cross-entropy over all answer tokens of the batch, each predicted from the token before it.

    logits: float32 (B, T, V). text_tokens: int32 (B, T). answer_mask, soft_mask: bool (B, T), True on answer tokens,
    and on those of them that name a bin (a gripper status is 0 or 1 and has no neighbour that is nearly right).
    targets: float32 (V, V) or None, from `target_distributions`.
    counts: `answer_counts` of the whole batch where these examples are a part of it; the sums over its parts are then
        the whole batch's loss and metrics.
    Returns the loss and metrics: token accuracy, and the share of bins that are within one of the target's.
    """
    labels, answer, soft = text_tokens[:, 1:], answer_mask[:, 1:], soft_mask[:, 1:]
    log_probabilities = jax.nn.log_softmax(logits[:, :-1].astype(jnp.float32))
    likelihood = jnp.take_along_axis(log_probabilities, labels[..., None], axis=-1)[..., 0]
    if targets is not None:
        likelihood = jnp.where(soft, jnp.einsum("btv,btv->bt", log_probabilities, targets[labels]), likelihood)
    count, soft_count = answer_counts(answer_mask, soft_mask) if counts is None else counts
    loss = -jnp.where(answer, likelihood, 0.0).sum() / count

    guess = log_probabilities.argmax(-1)
    # Integers are numbered in order in the vocabulary, so a distance in tokens is a distance in bins.
    near = jnp.abs(guess - labels) <= 1
    metrics = {
        "loss": loss,
        "token_accuracy": ((guess == labels) & answer).sum() / count,
        "bin_within_one": (near & soft & answer).sum() / soft_count,
    }
    return loss, metrics
