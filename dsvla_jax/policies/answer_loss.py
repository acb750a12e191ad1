"""The imitation objective: cross-entropy on the tokens of the answer, and on nothing else."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.policies.interface import Metrics
from dsvla_jax.types import Array, Example


def answer_counts(batch: Example[Array], targets: NumberTargets) -> tuple[Array, Array]:
    """Counts what `answer_loss` takes means over: tokens of a batch's answers, and bins in them; 1 for 0."""
    bins = jnp.asarray(targets.begins)[batch.number_rows[:, 1:]]
    return jnp.maximum(batch.answer_mask[:, 1:].sum(), 1), jnp.maximum(bins.sum(), 1)


def answer_loss(
    logits: Float[Array, "b t v"],
    batch: Example[Array],
    targets: NumberTargets,
    counts: tuple[Array, Array] | None = None,
) -> tuple[Array, Metrics]:
    """Mean cross-entropy over all answer tokens of the batch, each predicted from the token before it.

    targets: of the tokenizer and style that the batch was written with; `batch.number_rows` are rows of it.
    counts: `answer_counts` of the whole batch where these examples are a part of it; the sums over its parts are then
        the whole batch's loss and metrics.
    Returns the loss and metrics: token accuracy, and the share of bins that are within one of the target's. Where a
    bin is several tokens, each predicted after the target's own tokens, it counts if every one of them leads to a bin
    within one of the target's; whether the number ends in time shows in the token accuracy only.
    """
    labels, answer, rows = batch.text.tokens[:, 1:], batch.answer_mask[:, 1:], batch.number_rows[:, 1:]
    chooses = rows > 0
    log_probabilities = jax.nn.log_softmax(logits[:, :-1].astype(jnp.float32))
    likelihood = jnp.take_along_axis(log_probabilities, labels[..., None], axis=-1)[..., 0]
    if targets.weights is not None:
        offered = log_probabilities[..., targets.tokens]
        weights = jnp.asarray(targets.weights)[rows]
        # An accelerator would round float32 factors, and the loss with them, to fewer bits.
        expected = jnp.einsum("btu,btu->bt", offered, weights, precision=jax.lax.Precision.HIGHEST)
        likelihood = jnp.where(chooses, expected, likelihood)
    count, bins = answer_counts(batch, targets) if counts is None else counts
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
