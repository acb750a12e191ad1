"""The training loop: steps, numbers, checkpoints, and an end that loses nothing."""

import dataclasses
import math
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import jax
from tqdm import tqdm

from dsvla_jax.checkpoints.run import Arrays, Notes, Restored, RunCheckpoints
from dsvla_jax.experiment import Schedule
from dsvla_jax.json_values import Json
from dsvla_jax.model.variables import Regime, Variables
from dsvla_jax.policies.interface import Metrics
from dsvla_jax.policies.registry import ConfiguredLearner
from dsvla_jax.training.chips import peak_flops
from dsvla_jax.training.health import Clock, SkippedSteps, memory
from dsvla_jax.training.metrics import MetricsWriter
from dsvla_jax.training.signals import StopRequest
from dsvla_jax.training.state import TrainState

Step = Callable[[TrainState, object], tuple[TrainState, Metrics]]


class Batches(Protocol):
    """An endless stream of batches whose position can be saved as JSON."""

    def __next__(self) -> object:
        """The next batch, of what the run's learner learns from."""
        ...

    def get_state(self) -> dict[str, Json]:
        """The position, before the next batch."""
        ...

    def set_state(self, state: dict[str, Json]) -> None:
        """Goes to a position."""
        ...


@dataclasses.dataclass(frozen=True)
class PeriodicEval:
    """What is measured of a state at an interval of steps, and at the end."""

    name: str
    """For people, such as "validating"."""
    every: int
    """Steps; 0 for never."""
    run: Callable[[TrainState, Callable[[], bool]], dict[str, float]]
    """(state, whether to stop) -> figures by name; none if it stopped."""

    def is_due(self, step: int, last: int) -> bool:
        """Returns whether it runs after this step."""
        return self.every > 0 and (is_due(step, self.every) or step == last)


def is_due(step: int, every: int) -> bool:
    """Whether something that is done every so many steps, 0 for never, is done after this one."""
    return every > 0 and step % every == 0


def train(
    schedule: Schedule,
    run: Path,
    *,
    regime: Regime,
    state: TrainState,
    step: Step,
    batches: Batches,
    checkpoints: RunCheckpoints,
    metrics: MetricsWriter,
    learner: ConfiguredLearner,
    checks: Sequence[PeriodicEval] = (),
    note: Callable[[str], None] = lambda doing: None,
) -> signal.Signals | None:
    """Trains from the state's step to the schedule's last, saving on the way and at the end.

    regime: what is trained of the policy's variables.
    step: trains on this process's part of a batch; may consume the state that it is given.
    learner: of the policy that is trained, for what is counted and shown.
    checks: a step that their figures give a score (`score_of`) is saved, and its checkpoint carries the score.
    note: is told what is being done, in words that name the step.
    Returns the signal that asked to stop, None where training is finished. Either way the last step is on disk.
    Raises UserError where a checkpoint cannot be written, or too many steps were not finite.
    """
    first = done = int(state.step)
    name, words = learner.progress
    clock = Clock(learner.flops(regime), peak_flops(jax.devices()))
    skipped = SkippedSteps(run / "skipped", schedule.max_skipped_steps, int(state.skipped))
    bar = tqdm(total=schedule.steps, initial=first, unit="step", desc="train", disable=jax.process_index() > 0)
    stop: signal.Signals | None = None
    with bar, StopRequest() as request:
        bar.set_postfix_str("compiling the training step")
        for done in range(first + 1, schedule.steps + 1):
            note(f"reading data for step {done}")
            with clock.waiting():
                batch = next(batches)
            note(f"computing step {done}")
            state, values = step(state, batch)
            skipped.watch(done, batch, values["skipped_steps"])
            bar.update()
            if not clock.started():
                jax.block_until_ready(values)
                bar.set_postfix_str("")
                clock.start()
            else:
                clock.count(schedule.batch_size, learner.tokens(batch) * jax.process_count())
            figures: dict[str, float] = {}
            if is_due(done, schedule.log_every) or done == schedule.steps:
                numbers = {figure: float(value) for figure, value in values.items()}
                figures = {**numbers, **clock.read(), **memory()}
                shown = f", {words} {numbers[name]:.2f}" if name in numbers else ""
                bar.set_postfix_str(f"loss {numbers['loss']:.3f}{shown}")
                checkpoints.raise_if_failed()
            for check in checks:
                # Whoever asks to stop is not kept waiting.
                if check.is_due(done, schedule.steps) and not request.noted:
                    note(f"{check.name} step {done}")
                    bar.set_postfix_str(check.name)
                    jax.block_until_ready(values)
                    with clock.paused():
                        figures |= check.run(state, lambda: request.noted)
            if figures:
                metrics.write(done, figures)
            stop, score = request.after(done), score_of(figures)
            last = done == schedule.steps or stop is not None
            if is_due(done, schedule.checkpoint_every) or last or score is not None:
                skipped.settle()
                metrics.sync()
                with clock.paused():
                    checkpoints.save(done, arrays_of(state), notes_of(schedule, batches), score)
            if stop is not None:
                bar.set_postfix_str(f"{stop.name}: saving step {done}")
                break
    checkpoints.wait()
    return stop if done < schedule.steps else None


def resume(
    checkpoints: RunCheckpoints, state: TrainState, frozen: Variables, batches: Batches
) -> tuple[TrainState, Variables]:
    """Resumes from the newest checkpoint, with its place in the data. Without a checkpoint, saves the frozen variables.

    Returns the state and the frozen variables to train with. Raises CheckpointError for checkpoints that do not fit.
    """
    if checkpoints.latest_step is None:
        checkpoints.save_base(frozen)
        return state, frozen
    frozen = checkpoints.restore_base(frozen)
    restored = checkpoints.restore(arrays_of(state))
    batches.set_state(restored.notes.iterator)
    return state_of(restored), frozen


def score_of(figures: Mapping[str, float]) -> float | None:
    """What the best checkpoint is chosen by, the lower the better; None where nothing says how good a step is.

    Success in closed loop, turned round, or else the position error of answers: every step that was evaluated comes
    before those that were only validated.
    """
    if "evaluation/success" in figures:
        return -figures["evaluation/success"]
    error = figures.get("validation/position_cm", math.nan)
    return error if math.isfinite(error) else None


def arrays_of(state: TrainState) -> Arrays:
    """The state as `RunCheckpoints` keeps it."""
    counters = {"step": state.step, "skipped": state.skipped}
    return Arrays(state.trainable, state.optimizer, counters, {"key": state.rng}, state.average or {})


def notes_of(schedule: Schedule, batches: Batches) -> Notes:
    """What a checkpoint keeps besides arrays."""
    return Notes(iterator=batches.get_state(), config=dataclasses.asdict(schedule))


def state_of(restored: Restored) -> TrainState:
    """The inverse of `arrays_of`."""
    arrays = restored.arrays
    return TrainState(
        step=arrays.counters["step"],
        trainable=arrays.trainable,
        optimizer=arrays.optimizer,
        skipped=arrays.counters["skipped"],
        rng=arrays.rng["key"],
        average=arrays.average or None,
    )
