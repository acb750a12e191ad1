"""A policy with the tokenizer of a language model: from observation to action, and through a run folder."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.encoding.pretrained_tokenizers import save_tokenizer
from dsvla_jax.encoding.prompts import parse_answer
from dsvla_jax.encoding.text import WordTokenizer
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.interface import BATCH_SIZES, full_size
from dsvla_jax.policies.three_ds_vla import TextPolicy
from dsvla_jax.policy import load_policy, load_policy_config, load_vocabulary, save_policy_config
from dsvla_jax.types import Camera, Observation, Picture, RobotState
from tests.run_folders import MESHES, MODEL, NO_NOTES, variables_only, write_run
from tests.serving import PROMPTS, observation, tiny_policy
from tests.vocabularies import small_tokenizer


@pytest.fixture(scope="module")
def policy() -> TextPolicy:
    """A policy whose tokenizer splits digits."""
    small, tokenizer = tiny_policy(), small_tokenizer("sentencepiece")
    encoding = dataclasses.replace(small.config.encoding, max_text_length=200)
    language = dataclasses.replace(small.config.model.language, vocab_size=tokenizer.vocab_size)
    config = dataclasses.replace(
        small.config, encoding=encoding, model=dataclasses.replace(small.config.model, language=language)
    )
    variables = jax.jit(lambda: jax.tree.map(lambda x: 3.0 * x, initialize(config.model, jax.random.key(0))))()
    return TextPolicy(config, variables, tokenizer)


def batch(size: int) -> tuple[Observation, list[str], np.ndarray]:
    requests = [observation(seed) for seed in range(size)]
    stacked: Any = {name: np.stack([request[name] for request in requests]) for name in requests[0] if name != "prompt"}
    camera = Camera(stacked["intrinsics"], stacked["world_from_camera"])
    robot = RobotState(stacked["pose"], stacked["gripper_open"])
    observed = Observation(jax.tree.map(lambda x: x[:, None], Picture(stacked["rgb"], stacked["depth"], camera)), robot)
    return observed, [PROMPTS[seed % len(PROMPTS)] for seed in range(size)], stacked["keypoints"][:, :, 0]


def test_filling_a_batch_up_changes_no_action(policy):
    five, eight = policy.decide(*batch(5)), policy.decide(*batch(8))
    assert len(five.texts) == 5
    assert five.texts == eight.texts[:5]
    assert len(set(eight.texts)) > 1
    np.testing.assert_array_equal(five.action.pose, eight.action.pose[:5])
    assert five.log_probs.shape == five.entropies.shape == (5, 1, 8)
    np.testing.assert_allclose(five.log_probs, eight.log_probs[:5], atol=1e-4)
    for b, text in enumerate(five.texts):
        action = policy.codec.decode(parse_answer(text, 1, "compact"))
        np.testing.assert_allclose(five.action.pose[b], action.pose, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(five.action.pose[..., 3:], axis=-1), 1, atol=1e-5)


def test_few_sizes_are_compiled():
    assert all(full_size(size) == size for size in BATCH_SIZES)
    assert len({full_size(size) for size in range(1, 129)}) == len(BATCH_SIZES)
    assert [full_size(size) for size in (3, 20, 129, 300)] == [4, 25, 256, 384]


def words_run(tmp_path: Path, padding: int = 0) -> tuple[PolicyConfig, tuple[str, ...]]:
    """A run folder without checkpoints: what it says of itself, and its vocabulary's words."""
    config, tokenizer = tiny_policy().config, tiny_policy().tokenizer
    assert isinstance(tokenizer, WordTokenizer)
    language = dataclasses.replace(config.model.language, vocab_size=tokenizer.vocab_size + padding)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, language=language))
    save_policy_config(tmp_path, config, tokenizer)
    return load_policy_config(tmp_path), tokenizer.words


def test_a_run_folder_with_its_own_vocabulary_is_read(tmp_path):
    config, words = words_run(tmp_path, padding=9)
    assert load_vocabulary(tmp_path, config) == WordTokenizer(words)


@pytest.mark.parametrize("change", [lambda w: (*w, "zebra"), lambda w: w[:-29], lambda w: w[::-1]])
def test_a_run_folder_with_another_vocabulary_is_refused(tmp_path, change):
    """It has rows enough for one word more, and for fewer, and the right number in another order."""
    config, words = words_run(tmp_path, padding=9)
    save_tokenizer(WordTokenizer(change(words)), tmp_path)
    with pytest.raises(CheckpointError, match="its tokenizer files are not those that it was trained with"):
        load_policy(tmp_path)
    # A run from before the digest was written has its size alone to compare.
    older = dataclasses.replace(config, vocabulary=None)
    if len(change(words)) > len(words):
        rows = dataclasses.replace(config.model.language, vocab_size=config.model.language.vocab_size - 9)
        older = dataclasses.replace(older, model=dataclasses.replace(config.model, language=rows))
        with pytest.raises(CheckpointError, match="tokens for an embedding of"):
            load_vocabulary(tmp_path, older)
    else:
        load_vocabulary(tmp_path, older)


def test_a_run_folder_keeps_the_tokenizer(policy, tmp_path):
    checkpoints = RunCheckpoints(tmp_path)
    checkpoints.save(1, variables_only(policy.variables), NO_NOTES)
    checkpoints.close()
    save_policy_config(tmp_path, policy.config, policy.tokenizer)
    again = load_policy(tmp_path)
    assert again.tokenizer == policy.tokenizer
    assert again.act(*batch(8))[1] == policy.act(*batch(8))[1]


def test_a_run_trained_on_eight_devices_loads_on_one(tmp_path):
    """Split by `data` and by `fsdp`, with adapters on a frozen base."""
    devices = {"XLA_FLAGS": "--xla_force_host_platform_device_count=8", "JAX_PLATFORMS": "cpu"}
    root = Path(__file__).parent.parent
    command = [sys.executable, "-m", "tests.run_folders", str(tmp_path)]
    subprocess.run(command, cwd=root, env={**os.environ, **devices}, check=True, timeout=300)
    write_run(tmp_path / "one", MODEL)
    expected = load_policy(tmp_path / "one").variables
    for name in MESHES:
        assert (tmp_path / name / "base").exists()
        jax.tree.map(np.testing.assert_array_equal, load_policy(tmp_path / name).variables, expected)
