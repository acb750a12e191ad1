"""The imitation objective: cross-entropy on the tokens of the answer, and on nothing else."""

import jax
import jax.numpy as jnp

from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.types import Array


def answer_counts(answer_mask: Array, number_rows: Array, targets: NumberTargets) -> tuple[Array, Array]:
    """How much of (B, T) arrays `answer_loss` takes means over: tokens of answers, and bins in them; 1 for 0."""
    bins = jnp.asarray(targets.begins)[number_rows[:, 1:]]
    return jnp.maximum(answer_mask[:, 1:].sum(), 1), jnp.maximum(bins.sum(), 1)


def answer_loss(
    logits: Array,
    text_tokens: Array,
    answer_mask: Array,
    number_rows: Array,
    targets: NumberTargets,
    counts: tuple[Array, Array] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Mean cross-entropy over all answer tokens of the batch, each predicted from the token before it.

    logits: float32 (B, T, V). text_tokens: int32 (B, T). answer_mask: bool (B, T), True on answer tokens.
    number_rows: int32 (B, T), the rows of `targets` on those of them that choose a bin, 0 elsewhere.
    counts: `answer_counts` of the whole batch where these examples are a part of it; the sums over its parts are then
        the whole batch's loss and metrics.
    Returns the loss and metrics: token accuracy, and the share of bins that are within one of the target's. Where a
    bin is several tokens, each predicted after the target's own tokens, it counts if every one of them leads to a bin
    within one of the target's; whether the number ends in time shows in the token accuracy only.
    """
    labels, answer, rows = text_tokens[:, 1:], answer_mask[:, 1:], number_rows[:, 1:]
    chooses = rows > 0
    log_probabilities = jax.nn.log_softmax(logits[:, :-1].astype(jnp.float32))
    likelihood = jnp.take_along_axis(log_probabilities, labels[..., None], axis=-1)[..., 0]
    if targets.weights is not None:
        offered = log_probabilities[..., targets.tokens]
        weights = jnp.asarray(targets.weights)[rows]
        # An accelerator would round float32 factors, and the loss with them, to fewer bits.
        expected = jnp.einsum("btu,btu->bt", offered, weights, precision=jax.lax.Precision.HIGHEST)
        likelihood = jnp.where(chooses, expected, likelihood)
    count, bins = answer_counts(answer_mask, number_rows, targets) if counts is None else counts
    loss = -jnp.where(answer, likelihood, 0.0).sum() / count

    guess = log_probabilities.argmax(-1)
    near = (guess[..., None] == targets.tokens) & (jnp.abs(jnp.asarray(targets.offsets)) <= 1)[rows]
    far = chooses & ~near.any(-1)
    begins = jnp.asarray(targets.begins)[rows]
    # A number is far off if one of its tokens is: the first such token since its beginning counts.
    far_before = jnp.cumsum(far, axis=-1) - far
    at_beginning = jax.lax.cummax(jnp.where(begins, far_before, 0), axis=1)
    far_bins = (far & (far_before == at_beginning)).sum()
    metrics = {
        "loss": loss,
        "token_accuracy": ((guess == labels) & answer).sum() / count,
        "bin_within_one": (begins.sum() - far_bins) / bins,
    }
    return loss, metrics
