"""Which steps stay: the newest, and the one with the lowest score."""

from collections.abc import Callable, Mapping

import orbax.checkpoint as ocp
from orbax.checkpoint.checkpoint_managers import preservation_policy

SCORE = "score"


def metrics_of(score: float | None) -> dict[str, float]:
    """Returns what is kept of a step's score, the lower the better; nothing if it was not scored."""
    return {} if score is None else {SCORE: score}


def reading_options() -> ocp.CheckpointManagerOptions:
    """Returns the options for a reader, which creates and removes nothing."""
    return ocp.CheckpointManagerOptions(read_only=True, create=False, best_fn=_rank)


def writing_options(keep: int, when_written: Callable[[], None]) -> ocp.CheckpointManagerOptions:
    """Returns the options for the program that trains: `keep` of the newest steps stay, and the best.

    when_written: called in the background when all files of a step are written, before the step gets its final name.
    """
    latest = preservation_policy.LatestN(keep)
    best = preservation_policy.BestN(get_metric_fn=_rank, n=1, keep_checkpoints_without_metrics=False)
    return ocp.CheckpointManagerOptions(
        best_fn=_rank,
        preservation_policy=preservation_policy.AnyPreservationPolicy([latest, best]),
        async_options=ocp.AsyncOptions(
            post_finalization_callback=when_written,
            # Where a folder cannot be made in the background, orbax's other threads wait for it for minutes.
            create_directories_asynchronously=False,
        ),
    )


def best_step(manager: ocp.CheckpointManager) -> int | None:
    """Returns the step with the lowest score, or None if none was scored."""
    scores = {step: (manager.metrics(step) or {}).get(SCORE) for step in manager.all_steps()}
    scored = {step: score for step, score in scores.items() if score is not None}
    return min(scored, key=scored.__getitem__, default=None)


def _rank(metrics: Mapping[str, float]) -> float:
    """The higher the better."""
    return -metrics.get(SCORE, float("inf"))
