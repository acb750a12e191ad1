"""What a run folder keeps: exact, checked on the way back, and usable whatever happens to the newest checkpoint."""

import dataclasses
import resource
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.checkpoints.run import Notes, RunCheckpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.experiment import OptimizerConfig
from dsvla_jax.model.variables import join_variables, split_variables
from dsvla_jax.training.loop import arrays_of, state_of
from dsvla_jax.training.state import TrainState, make_optimizer, start_state

NOTES = Notes(iterator={"next_index": 7}, config={"steps": 10})


OPTIMIZER = make_optimizer(OptimizerConfig(), steps=10)


def variables(seed: int, width: int = 64) -> dict[str, Any]:
    """The form of a model's variables, without a model."""
    rng = np.random.default_rng(seed)

    def table(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return {
        "params": {"language": {"kernel": table(width, width)}, "projector": {"kernel": table(width, 8)}},
        "lora": {"language": {"a": table(width, 2)}},
    }


def state(seed: int, width: int = 64) -> TrainState:
    return jax.tree.map(jnp.asarray, start_state(variables(seed, width), OPTIMIZER, seed))


def save(run: Path, *steps: int, scores: tuple[float | None, ...] = (), keep: int = 2) -> None:
    with closing(RunCheckpoints(run, keep=keep)) as checkpoints:
        for i, step in enumerate(steps):
            checkpoints.save(step, arrays_of(state(step)), NOTES, scores[i] if scores else None)


def largest_file(run: Path, step: int) -> Path:
    files = (path for path in (run / "checkpoints" / str(step) / "trainable").rglob("*") if path.is_file())
    return max(files, key=lambda path: path.stat().st_size)


def assert_same(one, other) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_a_checkpoint_gives_back_the_whole_state(tmp_path: Path):
    saved = dataclasses.replace(state(3), step=jnp.int32(3), skipped=jnp.int32(1))
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        checkpoints.save(3, arrays_of(saved), NOTES)
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        restored = checkpoints.restore(arrays_of(state(0)))
    assert (restored.step, restored.notes) == (3, NOTES)
    assert_same(state_of(restored), saved)


def test_lora_checkpoint_holds_the_base_once_and_gives_all_variables(tmp_path: Path):
    trainable, frozen = split_variables(variables(1), "lora")
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        checkpoints.save_base(frozen)
        checkpoints.save(2, arrays_of(start_state(trainable, OPTIMIZER, 0)), NOTES)
    with closing(RunCheckpoints(tmp_path, read_only=True)) as checkpoints:
        loaded = checkpoints.restore_variables(jax.eval_shape(lambda: variables(0)))
    assert_same(loaded, join_variables(trainable, frozen))


def test_a_checkpoint_of_another_size_is_refused_by_name(tmp_path: Path):
    save(tmp_path, 1)
    with (
        closing(RunCheckpoints(tmp_path)) as checkpoints,
        pytest.raises(CheckpointError, match=r"another model: .*expected \(32, 2\), found \(64, 2\)"),
    ):
        checkpoints.restore(arrays_of(state(0, width=32)))


def test_an_empty_run_says_how_to_train(tmp_path: Path):
    for read_only in (True, False):
        with (
            closing(RunCheckpoints(tmp_path, read_only=read_only)) as checkpoints,
            pytest.raises(CheckpointError, match="no complete checkpoint; train first"),
        ):
            checkpoints.restore(arrays_of(state(0)))


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_a_damaged_base_is_refused(tmp_path: Path):
    _, frozen = split_variables(variables(1), "lora")
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        checkpoints.save_base(frozen)
        assert_same(checkpoints.restore_base(frozen), frozen)
        files = [path for path in (tmp_path / "base").rglob("*") if path.is_file() and path.name != "digests.json"]
        flip(max(files, key=lambda path: path.stat().st_size))
        with pytest.raises(CheckpointError, match=r"base is damaged: .*sha256"):
            checkpoints.restore_base(frozen)


def test_a_base_whose_writing_was_cut_short_is_written_again(tmp_path: Path):
    _, frozen = split_variables(variables(1), "lora")
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        checkpoints.save_base(split_variables(variables(2), "lora")[1])
        (tmp_path / "base" / "digests.json").unlink()
        checkpoints.save_base(frozen)
        assert_same(checkpoints.restore_base(frozen), frozen)


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (flip, "sha256"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "bytes"),
        (lambda path: path.unlink(), "is missing"),
    ],
    ids=["one bit", "truncated", "missing"],
)
def test_a_damaged_newest_checkpoint_falls_back_loudly(tmp_path: Path, caplog, harm, told: str):
    save(tmp_path, 1, 2)
    harm(largest_file(tmp_path, 2))
    with closing(RunCheckpoints(tmp_path, read_only=True)) as checkpoints:
        assert checkpoints.latest_step == 1
        assert_same(state_of(checkpoints.restore(arrays_of(state(0)))), state(1))
        with pytest.raises(CheckpointError, match="2 is damaged"):
            checkpoints.restore(arrays_of(state(0)), step=2)
    assert (tmp_path / "checkpoints" / "2").exists(), "a reader moves nothing"
    caplog.clear()
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        assert "2 is DAMAGED" in caplog.text
        assert told in caplog.text
        assert "Falling back to step 1" in caplog.text
        assert_same(state_of(checkpoints.restore(arrays_of(state(0)))), state(1))
        checkpoints.save(2, arrays_of(state(2)), NOTES)
    assert (tmp_path / "checkpoints" / "damaged" / "2").exists()
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        assert_same(state_of(checkpoints.restore(arrays_of(state(0)))), state(2))


def test_training_does_not_start_over_where_all_checkpoints_are_damaged(tmp_path: Path):
    save(tmp_path, 1, 2)
    for step in (1, 2):
        flip(largest_file(tmp_path, step))
    with pytest.raises(CheckpointError, match=r"every checkpoint is damaged .*step 2.*step 1"):
        RunCheckpoints(tmp_path)
    assert (tmp_path / "checkpoints" / "2").exists()


def test_the_newest_and_the_best_are_kept(tmp_path: Path):
    save(tmp_path, 1, 2, 3, 4, 5, 6, scores=(3.0, 1.0, None, 2.0, None, 4.0), keep=2)
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"2", "5", "6"}
    like = jax.eval_shape(lambda: state(0).trainable)
    with closing(RunCheckpoints(tmp_path, read_only=True)) as checkpoints:
        assert (checkpoints.best_step, checkpoints.latest_step) == (2, 6)
        assert_same(checkpoints.restore_variables(like, "best"), state(2).trainable)
        with pytest.raises(CheckpointError, match=r"no checkpoint of step 4; there are \[2, 5, 6\]"):
            checkpoints.restore_variables(like, 4)


@contextmanager
def files_limited_to(size: int) -> Iterator[None]:
    """Every write behind the first `size` bytes of a file fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_what_cannot_be_written_leaves_the_previous_checkpoint_usable(tmp_path: Path):
    save(tmp_path, 1)
    arrays = arrays_of(state(2))
    checkpoints = RunCheckpoints(tmp_path)
    told = pytest.raises(CheckpointError, match=r"could not be written .*step 1 is whole")
    with told, closing(checkpoints), files_limited_to(1000):
        checkpoints.save(2, arrays, NOTES)
        checkpoints.wait()
    with closing(RunCheckpoints(tmp_path)) as checkpoints:
        assert_same(state_of(checkpoints.restore(arrays_of(state(0)))), state(1))
        checkpoints.save(2, arrays, NOTES)
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"1", "2"}


def test_a_folder_that_is_gone_is_told(tmp_path: Path):
    checkpoints = RunCheckpoints(tmp_path)
    shutil.rmtree(tmp_path / "checkpoints")
    (tmp_path / "checkpoints").write_text("")
    told = pytest.raises(CheckpointError, match=r"could not be written .*there is no earlier one")
    with told, closing(checkpoints):
        checkpoints.save(1, arrays_of(state(0)), NOTES)


@pytest.mark.parametrize("name", ["lr=[0.1]", "all*", "which?", "back\\slash"])
def test_a_folder_whose_arrays_could_not_be_read_is_refused_before_anything_is_written(tmp_path: Path, name: str):
    with pytest.raises(CheckpointError, match=r"whose path contains [\[*?\\]; choose another folder"):
        RunCheckpoints(tmp_path / name / "run")
    assert not list(tmp_path.iterdir())


def test_a_run_that_was_moved_to_a_folder_with_brackets_is_read(tmp_path: Path):
    save(tmp_path / "run", 1)
    (tmp_path / "run").rename(tmp_path / "lr=[0.1]")
    with closing(RunCheckpoints(tmp_path / "lr=[0.1]", read_only=True)) as checkpoints:
        assert_same(checkpoints.restore_variables(jax.eval_shape(lambda: state(0).trainable)), state(1).trainable)


def test_arrays_without_their_index_do_not_count_as_saved(tmp_path: Path, monkeypatch):
    # In such a folder orbax leaves the index out without a word.
    monkeypatch.setattr("dsvla_jax.checkpoints.run.PATTERN_CHARACTERS", "")
    checkpoints = RunCheckpoints(tmp_path / "[1]")
    with pytest.raises(CheckpointError, match=r"base: manifest.ocdbt is missing"):
        checkpoints.save_base(variables(1))
    with (
        pytest.raises(CheckpointError, match=r"could not be written .*manifest.ocdbt is missing"),
        closing(checkpoints),
    ):
        checkpoints.save(1, arrays_of(state(1)), NOTES)
    assert not (tmp_path / "[1]" / "checkpoints" / "1").exists()
