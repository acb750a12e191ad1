"""Training from a folder that the simulator did not write."""

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from data_pipelines.episodes import EpisodeReader
from data_pipelines.loader import make_loader
from data_pipelines.rlbench.__main__ import Settings, import_demonstrations
from data_pipelines.samples import make_sampler
from data_pipelines.sources import choose_tasks, open_demonstrations
from data_pipelines.vocabulary import write_vocabulary
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.variables import split_variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.state import make_optimizer, start_state
from tests import rlbench_files as files
from tests.learning import step_of
from tests.small import small_encoding, small_language, small_vision

TASKS = ["lamp_on", "bimanual_lift_ball"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("out")
    files.write_dataset(source, TASKS, episodes=2, size=48, descriptions=["close the box"])
    import_demonstrations(source, out, Settings(), progress=False)
    return out


def data_config(folder, **changes):
    return dataclasses.replace(DataConfig(source="episodes", folder=str(folder), tasks=("all",)), **changes)


def test_tasks_and_episodes_are_those_of_the_folder(folder, capsys):
    assert choose_tasks(data_config(folder)) == ("bimanual_lift_ball", "lamp_on")
    assert choose_tasks(data_config(folder, tasks=("lamp_on",))) == ("lamp_on",)
    with pytest.raises(UserError, match=r"tasks: expected some of \['bimanual_lift_ball', 'lamp_on'\], got \['push'\]"):
        choose_tasks(data_config(folder, tasks=("push",)))
    with pytest.raises(UserError, match=r"index.json: file: .*docs/data_own.md"):
        choose_tasks(data_config(folder / "elsewhere"))
    assert len(open_demonstrations(data_config(folder, tasks=("lamp_on",)), suite_tokenizer())) == 2
    assert capsys.readouterr().out == ""
    # A task named twice is in the data once.
    for twice in (("lamp_on", "lamp_on"), ("lamp_on,lamp_on",)):
        assert choose_tasks(data_config(folder, tasks=twice)) == ("lamp_on",)
    assert EpisodeReader(folder, ["lamp_on", "lamp_on"]).num_frames == EpisodeReader(folder, ["lamp_on"]).num_frames
    for source in ("episodes", "simulator"):
        with pytest.raises(UserError, match=r"data.tasks: expected names of tasks, got"):
            choose_tasks(data_config(folder, source=source, tasks=(",",)))
    few = data_config(folder, tasks=("lamp_on",), episodes=1)
    assert len(open_demonstrations(few, suite_tokenizer())) == 1
    assert "1 of 2 demonstrations are used" in capsys.readouterr().out


def test_unknown_words_need_a_vocabulary(tmp_path, capsys):
    files.write_dataset(
        tmp_path / "source", ["rinse_mug"], 1, size=8, frames=8, descriptions=["rinse the mug, 2 times"]
    )
    import_demonstrations(tmp_path / "source", tmp_path / "out", Settings(), progress=False)
    data = data_config(tmp_path / "out", tasks=("rinse_mug",))
    with pytest.raises(UserError, match=r"no token for 'mug', 'rinse', 'times'; write one with .*vocabulary"):
        open_demonstrations(data, suite_tokenizer())
    write_vocabulary(tmp_path / "words", EpisodeReader(tmp_path / "out").instructions)
    tokenizer: Any = load_tokenizer(tmp_path / "words")
    assert f"--model.language.vocab-size {tokenizer.vocab_size}" in capsys.readouterr().out
    open_demonstrations(data, tokenizer)
    assert set(suite_tokenizer().words) < set(tokenizer.words)


def test_an_imported_folder_is_learned(folder):
    """One and two arms in a batch; a few steps on it fit it better."""
    tokenizer = suite_tokenizer()
    experiment = Experiment(
        encoding=small_encoding(max_text_length=56),
        model=ModelConfig(
            vision=small_vision(),
            language=small_language(tokenizer.vocab_size),
        ),
        data=data_config(folder),
        optimizer=OptimizerConfig(learning_rate=1e-2, warmup_steps=1),
        steps=30,
        batch_size=8,
    )
    reader = open_demonstrations(experiment.data, tokenizer)
    loader = make_loader(reader, make_sampler(experiment.data, experiment.encoding, tokenizer), batch_size=8, seed=0)
    trainable, frozen = split_variables(initialize(experiment.model, jax.random.key(0)), "full")
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    targets = number_rows(tokenizer, "compact").targets(experiment.soft_target_sigma)
    state = start_state(trainable, optimizer, experiment.seed)
    step = jax.jit(step_of(experiment, optimizer, targets))
    losses = []
    for _ in range(experiment.steps):
        state, metrics = step(state, frozen, next(loader))
        losses.append(float(metrics["loss"]))
    assert np.mean(losses[-5:]) < 0.5 * losses[0]


def test_without_keypoints_the_prompt_goes_without(folder, tmp_path):
    source = files.write_dataset(tmp_path / "source", ["lamp_on"], 1, size=8, frames=8, descriptions=["close the box"])
    import_demonstrations(source, tmp_path / "out", Settings(keypoints="none"), progress=False)
    encoding = EncodingConfig(style="compact", max_text_length=56)
    texts = {}
    for path in (folder, tmp_path / "out"):
        data = data_config(path, tasks=("lamp_on",))
        reader = open_demonstrations(data, suite_tokenizer())
        sample = make_sampler(data, encoding, suite_tokenizer())(reader.frame(0), np.random.default_rng(0))
        texts[path] = suite_tokenizer().decode(sample.text.tokens[sample.text.mask].tolist())
    assert "near" in texts[folder]
    assert "near" not in texts[tmp_path / "out"]


@pytest.mark.slow
def test_the_tiny_config_trains_on_an_imported_folder(folder, tmp_path):
    options = f"--run {tmp_path / 'run'} --data.source episodes --data.folder {folder} --data.tasks all --steps 3"
    subprocess.run(
        [sys.executable, "train.py", "tiny", *options.split(), "--batch-size", "4"],
        cwd=Path(__file__).parent.parent,
        check=True,
    )
    assert (tmp_path / "run" / "metrics.jsonl").exists()
