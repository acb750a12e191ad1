"""A run that an earlier version trained and evaluated, kept in tests/golden/run.

40 steps of `train.py tiny` at the sizes of `tests.small.SMALL_RUN`, 8 demonstrations of lamp_on, then
`eval.py RUN --episodes 4`, with the code of November 2026 before the data had types.
"""

import shutil
from contextlib import closing
from functools import partial
from pathlib import Path

import jax
import numpy as np

import eval as program
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.evaluation.results import read_results
from dsvla_jax.experiment import load_experiment
from dsvla_jax.policy import load_policy_config
from dsvla_jax.training.loop import arrays_of, state_of
from dsvla_jax.training.state import make_optimizer
from tests.learning import start_of

RUN = Path(__file__).parent / "golden" / "run"


def test_a_run_of_an_earlier_version_evaluates_to_the_same_outcomes(tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(RUN, run)
    earlier = read_results(run / "eval")
    assert [result.success for result in earlier] == [False, False, True, False]
    program.main(program.Options(run, episodes=4, out=tmp_path / "again"))
    again = read_results(tmp_path / "again")
    assert again == earlier, "the same outcomes, answers and conditions, the checkpoint's digest among them"


def test_what_earlier_versions_called_otherwise_is_read(tmp_path: Path):
    for name in ("config.json", "policy.json"):
        text = (RUN / name).read_text().replace('"attention": "auto"', '"attention": "by_hand"')
        assert "by_hand" in text
        (tmp_path / name).write_text(text)
    assert load_experiment(tmp_path / "config.json").model.attention == "explicit"
    config = load_policy_config(tmp_path)
    assert config.model.attention == "explicit"
    assert config.learned_from is not None
    assert config.learned_from.cameras == ("front",)


def test_training_state_of_an_earlier_version_is_restored():
    experiment = load_experiment(RUN / "config.json")
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    like, _ = jax.eval_shape(partial(start_of, experiment, None, optimizer))
    like = jax.tree.map(lambda leaf: leaf.update(sharding=jax.sharding.SingleDeviceSharding(jax.devices()[0])), like)
    with closing(RunCheckpoints(RUN, read_only=True)) as checkpoints:
        restored = checkpoints.restore(arrays_of(like))
    state = state_of(restored)
    assert (restored.step, int(state.step), int(state.skipped)) == (40, 40, 0)
    assert jax.tree.structure(state) == jax.tree.structure(like)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.trainable))
