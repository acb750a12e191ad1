"""A run that is stopped goes on as if nothing had happened; a step that is not finite is skipped, counted and shown."""

import dataclasses
import functools
import json
import os
import signal
from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import grain
import jax
import numpy as np
import pytest

from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment
from dsvla_jax.model.variables import split_variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.training import loop
from dsvla_jax.training.metrics import MetricsWriter, rewind
from dsvla_jax.training.state import TrainState, make_optimizer, start_state
from dsvla_jax.types import Example, named_arrays
from tests.learning import learner_of, step_of
from tests.test_training import NO_NUMBERS, VOCABULARY, random_batch, small_experiment

SMALL = small_experiment(log_every=1, checkpoint_every=3, seed=1)
EXPERIMENT = replace(SMALL, model=replace(SMALL.model, lora=None, language=replace(SMALL.model.language, layers=1)))


class Interrupted(Exception):
    """What a test raises where the process would be killed."""


@functools.cache
def compiled_step():
    optimizer = make_optimizer(EXPERIMENT.optimizer, EXPERIMENT.steps)
    return jax.jit(step_of(EXPERIMENT, optimizer, NO_NUMBERS), donate_argnums=0)


@functools.cache
def initial_variables():
    return jax.device_get(initialize(EXPERIMENT.model, jax.random.key(EXPERIMENT.seed)))


def start() -> TrainState:
    trainable, _ = split_variables(jax.tree.map(jax.numpy.array, initial_variables()), EXPERIMENT.regime)
    state = start_state(trainable, make_optimizer(EXPERIMENT.optimizer, EXPERIMENT.steps), EXPERIMENT.seed)
    return jax.device_put(state, jax.devices()[0])


def make_stream(bad: Collection[int]):
    """Batches of random samples; those numbered in `bad` have a camera of NaN, as a damaged recording might."""

    def sample(number: int, rng: np.random.Generator) -> Example[np.ndarray]:
        one = jax.tree.map(lambda leaf: leaf[0], random_batch(EXPERIMENT))
        tokens = rng.integers(4, VOCABULARY, one.text.tokens.shape).astype(np.int32)
        camera = one.pictures.camera
        seen = replace(camera, world_from_camera=camera.world_from_camera * np.float32(np.nan if number in bad else 1))
        return replace(one, pictures=replace(one.pictures, camera=seen), text=replace(one.text, tokens=tokens))

    data = grain.MapDataset.range(1000).seed(EXPERIMENT.seed).random_map(sample).batch(EXPERIMENT.batch_size)
    return iter(data.to_iter_dataset(grain.ReadOptions(num_threads=0, prefetch_buffer_size=0)))


def train(
    run: Path,
    experiment: Experiment = EXPERIMENT,
    bad: Collection[int] = (),
    at_step: Callable[[int], None] = lambda step: None,
    checks: Sequence[loop.PeriodicEval] = (),
) -> signal.Signals | None:
    """Trains as train.py does; `at_step` is called before each step of this process."""
    run.mkdir(exist_ok=True)
    batches, state = make_stream(bad), start()

    def step(state: TrainState, batch):
        at_step(int(state.step) + 1)
        return compiled_step()(state, {}, batch)

    with closing(RunCheckpoints(run)) as checkpoints:
        state, _ = loop.resume(checkpoints, state, {}, batches)
        with MetricsWriter(run, int(state.step)) as metrics:
            return loop.train(
                experiment,
                run,
                regime=experiment.regime,
                state=state,
                step=step,
                batches=batches,
                checkpoints=checkpoints,
                metrics=metrics,
                learner=learner_of(experiment),
                checks=checks,
            )


def losses(run: Path) -> dict[int, float]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert len({line["step"] for line in lines}) == len(lines), "each step once"
    return {line["step"]: line["loss"] for line in lines}


def final_state(run: Path, step: int | None = None) -> TrainState:
    with closing(RunCheckpoints(run, read_only=True)) as checkpoints:
        return loop.state_of(checkpoints.restore(loop.arrays_of(start()), step))


def assert_same_run(one: Path, other: Path) -> None:
    assert losses(one) == losses(other)
    first, second = final_state(one), final_state(other)
    jax.tree.map(np.testing.assert_array_equal, dataclasses.replace(first, rng=0), dataclasses.replace(second, rng=0))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("uninterrupted")
    assert train(run) is None
    return run


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_the_run_goes_on_exactly(tmp_path: Path, uninterrupted: Path, number: signal.Signals):
    assert train(tmp_path, at_step=lambda step: os.kill(os.getpid(), number) if step == 5 else None) == number
    assert list(losses(tmp_path)) == [1, 2, 3, 4, 5]
    assert int(final_state(tmp_path).step) == 5
    assert train(tmp_path) is None
    assert_same_run(tmp_path, uninterrupted)


def test_a_signal_while_episodes_run_gives_them_up_and_saves(tmp_path: Path, uninterrupted: Path):
    def evaluate(state: TrainState, stop: Callable[[], bool]) -> dict[str, float]:
        assert not stop()
        if int(state.step) == 5:
            os.kill(os.getpid(), signal.SIGTERM)
        return {} if stop() else {"evaluation/success": 1 / int(state.step)}

    checks = [loop.PeriodicEval("evaluating", 1, evaluate)]
    assert train(tmp_path, checks=checks) == signal.SIGTERM
    with closing(RunCheckpoints(tmp_path, read_only=True)) as checkpoints:
        assert (checkpoints.best_step, checkpoints.latest_step) == (1, 5)
    assert train(tmp_path, checks=checks) is None
    assert_same_run(tmp_path, uninterrupted)


def test_success_comes_before_errors_of_answers_and_nan_is_no_score():
    evaluated = {"evaluation/success": 0.25, "validation/position_cm": 9.0}
    failed = {"evaluation/success": 0.0, "validation/position_cm": 0.1}
    order = [{"evaluation/success": 0.5}, evaluated, failed, {"validation/position_cm": 0.1}]
    scores = [loop.score_of(figures) for figures in order]
    assert scores == sorted(scores, key=lambda score: score if score is not None else np.nan)
    assert loop.score_of({"loss": 1.0}) is None
    assert loop.score_of({"validation/position_cm": np.nan}) is None


def test_a_death_between_checkpoints_leaves_no_trace(tmp_path: Path, uninterrupted: Path):
    def die(step: int) -> None:
        if step == 6:
            raise Interrupted

    with pytest.raises(Interrupted):
        train(tmp_path, at_step=die)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 6, "los')
    assert train(tmp_path) is None
    assert_same_run(tmp_path, uninterrupted)


def test_a_nan_batch_is_skipped_counted_and_kept(tmp_path: Path):
    bad_step, size = 4, EXPERIMENT.batch_size
    experiment = replace(EXPERIMENT, checkpoint_every=6, steps=6)
    assert train(tmp_path, experiment, bad={(bad_step - 1) * size + 2}) is None
    after = losses(tmp_path)
    assert after[bad_step] is None
    assert np.isfinite([loss for step, loss in after.items() if step != bad_step]).all()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["skipped_steps"] for line in lines] == [0, 0, 0, 1, 1, 1]
    (file,) = (tmp_path / "skipped").iterdir()
    assert file.name == "step-00000004.npz"
    with np.load(file, allow_pickle=False) as batch:
        assert np.isnan(batch["pictures.camera.world_from_camera"]).any(axis=(1, 2, 3)).tolist() == [
            False,
            False,
            True,
            False,
        ]
        assert set(batch) == set(named_arrays(random_batch(EXPERIMENT)))
    assert int(final_state(tmp_path).skipped) == 1


def test_a_skipped_step_changes_neither_variables_nor_optimizer():
    before = start()
    batch = next(make_stream(bad={0}))
    kept = jax.device_get((before.trainable, before.optimizer))
    after, _ = compiled_step()(before, {}, batch)
    jax.tree.map(np.testing.assert_array_equal, (after.trainable, after.optimizer), kept)
    assert (int(after.step), int(after.skipped)) == (1, 1)


def test_too_many_skipped_steps_end_the_run_and_lose_nothing(tmp_path: Path):
    bad = set(range(4 * EXPERIMENT.batch_size, 1000))
    experiment = replace(EXPERIMENT, max_skipped_steps=2)
    for _ in range(2):  # the second attempt goes on from the checkpoint, to the same end
        with pytest.raises(UserError, match=r"step 7: .*more than max_skipped_steps 2: look for NaN in the data"):
            train(tmp_path, experiment, bad)
    assert sorted(path.name for path in (tmp_path / "skipped").iterdir()) == [
        f"step-{step:08d}.npz" for step in (5, 6, 7)
    ]
    assert int(final_state(tmp_path, 3).skipped) == 0


def test_rewinding_drops_later_and_broken_lines_only(tmp_path: Path):
    file = tmp_path / "metrics.jsonl"
    rewind(file, 3)
    assert not file.exists()
    file.write_text('{"step": 2, "loss": 1.5}\n{"step": 3, "loss": null}\n{"step": 4, "loss": 1}\n{"step": 3')
    rewind(file, 3)
    assert file.read_text() == '{"step": 2, "loss": 1.5}\n{"step": 3, "loss": null}\n'
    rewind(file, 0)
    assert file.read_text() == ""
