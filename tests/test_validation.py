"""Validation: errors of answers against what is counted by hand, and a run that is the same with it as without."""

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import train
from data_pipelines.episodes import EpisodeReader, write_episodes
from data_pipelines.samples import make_validation_sampler
from data_pipelines.sources import open_held_out
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.encoding.encode import encode_text
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.pretrained_tokenizers import save_tokenizer
from dsvla_jax.encoding.prompts import format_answer, format_prompt
from dsvla_jax.encoding.text import Tokenizer, WordTokenizer, vocabulary
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, OptimizerConfig, ValidationConfig
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.policies.answer_errors import guess_integers, number_errors
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.distributed import Watchdog
from dsvla_jax.types import HeldOutExample
from tests.random_data import random_episode, text_example
from tests.small import small_encoding, small_language, small_vision
from tests.vocabularies import KINDS, small_tokenizer


def number_batch(tokenizer: Tokenizer, truth: np.ndarray) -> HeldOutExample[np.ndarray]:
    """One validation example with this answer (A, 8), as a batch."""
    numbers = number_rows(tokenizer, "paper")
    prompt = format_prompt("lift the tray", truth, None, "paper")
    text, answer = encode_text(tokenizer, prompt, format_answer(truth, "paper"), 500)
    rows, number_of, integers = np.zeros(500, np.int32), np.zeros(500, np.int32), np.zeros((2, 8), np.int32)
    rows[answer], number_of[answer] = numbers.rows(truth), numbers.numbers(truth)
    integers[: len(truth)] = truth
    example = text_example(text.tokens[None], answer[None], rows[None])
    return HeldOutExample(example, integers[None], number_of[None])


def most_probable(
    tokenizer: Tokenizer, truth: np.ndarray, logits: np.ndarray, batch: HeldOutExample[np.ndarray]
) -> np.ndarray:
    """What `guess_integers` should say, number by number and token by token."""
    place, guesses = int(batch.example.answer_mask[0].argmax()), []
    grammar = build_answer_grammar(tokenizer, len(truth), "paper")
    for index, (slot, value) in enumerate(zip(grammar.slots, truth.ravel(), strict=True)):
        place += len(grammar.templates[index])
        numbers = dict(zip(slot.tokens, slot.values, strict=True))
        right, guess = slot.tokens[value - slot.low], value
        for depth, token in enumerate(right):
            under = [tokens for tokens in numbers if tokens[:depth] == right[:depth] and len(tokens) > depth]
            predicted = logits[0, place + depth - 1]
            offered = sorted({tokens[depth] for tokens in under}) if index % 8 < 7 else list(range(len(predicted)))
            best = max(offered, key=lambda token: predicted[token])
            if best != token:
                leads = [numbers[tokens] for tokens in under if tokens[depth] == best]
                guess = min(leads, key=lambda other: abs(other - value)) if index % 8 < 7 else 1 - value
                break
        guesses.append(guess)
        place += len(right)
    return np.array(guesses).reshape(truth.shape)


@pytest.mark.parametrize("kind", KINDS)
def test_the_most_probable_numbers_are_found(kind):
    tokenizer, rng = small_tokenizer(kind), np.random.default_rng(0)
    targets = number_rows(tokenizer, "paper").targets(0.0)
    differing = 0
    for arms in (1, 2, 1, 2):
        truth = np.concatenate([rng.integers(-100, 101, (arms, 6)), rng.integers(0, 2, (arms, 2))], axis=1)
        batch = number_batch(tokenizer, truth)
        logits = rng.normal(size=(1, 500, tokenizer.vocab_size)).astype(np.float32)
        # The right tokens are probable enough for numbers to be right, or wrong at their last token only.
        right = batch.example.text.tokens[:, 1:, None]
        np.put_along_axis(logits[:, :-1], right, rng.normal(2.5, 1, (1, 499, 1)), axis=2)
        guess = np.asarray(guess_integers(jnp.asarray(logits), jax.tree.map(jnp.asarray, batch), targets))[0]
        np.testing.assert_array_equal(guess[:arms], most_probable(tokenizer, truth, logits, batch))
        differing += (guess[:arms] != truth).sum()
    assert 5 < differing < 40, "some are wrong, and some are right"


def test_errors_are_those_of_the_poses():
    truth = np.array(
        [[[30, -10, 140, 0, 100, 0, 0, 1], [0, 0, 100, 0, 0, 0, 100, 0]], [[0, 0, 100, 0, 0, 0, 100, 1]] * 2]
    )
    guess = truth.copy()
    guess[0, 0] += [3, 0, 4, 0, 0, 0, 0, 0]  # 3 and 4 cm: 5 cm off
    guess[0, 1] = [0, 0, 100, 0, 0, 71, 71, 1]  # a quarter turn about z, and the wrong status
    guess[1, 0, :7] = [1, 0, 100, 0, 0, 0, 0]  # no rotation is no turn
    guess[1, 1] = 77  # there is no second arm here
    number_of = np.array([[0, 1, 16], [0, 1, 8]])
    nothing = np.zeros_like(number_of)
    batch = HeldOutExample(text_example(nothing, nothing > 0, nothing), truth, number_of)
    batch = jax.tree.map(jnp.asarray, batch)
    figures = {
        name: float(total / count)
        for name, (total, count) in number_errors(jnp.asarray(guess), batch, small_encoding().codec).items()
    }
    expected = {
        "bin_exact": (5 / 7 + 5 / 7 + 5 / 7) / 3,
        "bin_within_one": (5 / 7 + 5 / 7 + 6 / 7) / 3,
        "position_cm": (5 + 0 + 1) / 3,
        "rotation_degrees": 90 / 3,
        "gripper": 2 / 3,
    }
    assert figures == pytest.approx(expected, rel=1e-4)


def test_samples_to_validate_with_are_as_recorded(tmp_path: Path):
    write_episodes(tmp_path, [random_episode(0, arms=2), random_episode(1, task="stack_blocks")])
    encoding, tokenizer = small_encoding(max_text_length=96), suite_tokenizer()
    data = DataConfig(shift_world=0.2, crop=0.5, state_jitter=0.1, keypoint_noise=0.1, colour_variation=0.5)
    sample = make_validation_sampler(data, encoding, tokenizer)
    reader = EpisodeReader(tmp_path)
    for number, arms in ((0, 2), (3, 1)):
        frame = reader.frame(number)
        one, other = (sample(frame, np.random.default_rng(seed)) for seed in (1, 2))
        jax.tree.map(np.testing.assert_array_equal, one, other)
        np.testing.assert_array_equal(one.example.pictures.rgb, frame.pictures.rgb)
        bins = encoding.codec.encode(frame.target.pose, frame.target.gripper_open)
        np.testing.assert_array_equal(one.integers[:arms], bins)
        # Its tokens spell each number.
        for index, value in enumerate(np.asarray(bins).ravel()):
            tokens = one.example.text.tokens[one.number_of == index + 1]
            assert tokenizer.decode(tokens.tolist()).strip() == str(value)


def test_held_out_demonstrations_are_whole_episodes_that_training_leaves(tmp_path: Path):
    write_episodes(tmp_path, [random_episode(seed, frames=2) for seed in range(7)], per_shard=3)
    data = DataConfig(source="episodes", folder=str(tmp_path), tasks=("lamp_on",), episodes=4)
    tokenizer = small_tokenizer("digits")
    held_out = open_held_out(data, tokenizer, 2)
    assert [held_out.episode(number).seed for number in range(len(held_out))] == [4, 5]
    assert held_out.frame(3).instruction == "do lamp_on number 5"
    with pytest.raises(UserError, match=r"training uses all demonstrations of lamp_on.*--data\.episodes"):
        open_held_out(dataclasses.replace(data, episodes=7), tokenizer, 2)


def small_run(folder: Path, **changes: Any) -> Experiment:
    """An experiment on random recordings of one and of two arms that compiles in seconds; writes what it needs."""
    episodes = [random_episode(seed, task=("one", "two")[seed % 2], arms=1 + seed % 2, size=32) for seed in range(8)]
    write_episodes(folder / "data", episodes)
    tokenizer = WordTokenizer(vocabulary(episode.instruction for episode in episodes))
    (folder / "words").mkdir(exist_ok=True)
    save_tokenizer(tokenizer, folder / "words")
    return Experiment(
        encoding=small_encoding(max_text_length=64),
        model=ModelConfig(small_vision(), small_language(tokenizer.vocab_size)),
        data=DataConfig(source="episodes", folder=str(folder / "data"), tasks=("all",), episodes=3),
        tokenizer=str(folder / "words"),
        validation=ValidationConfig(episodes=1, batches=2),
        optimizer=OptimizerConfig(learning_rate=0.03),
        steps=6,
        batch_size=2,
        log_every=2,
        checkpoint_every=4,
        keep_checkpoints=1,
        **changes,
    )


def lines_of(run: Path) -> dict[int, dict[str, float]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert len({line["step"] for line in lines}) == len(lines), "each step once"
    return {line.pop("step"): line for line in lines}


def test_validation_changes_nothing_and_the_best_step_stays(tmp_path: Path):
    plain = small_run(tmp_path)
    lines, variables, best, kept = {}, {}, {}, {}
    for name, experiment in (("plain", plain), ("validated", dataclasses.replace(plain, validate_every=3))):
        run = tmp_path / name
        assert train.main(experiment, run, Watchdog(run / "processes")) == 0
        lines[name] = lines_of(run)
        kept[name] = {int(path.name) for path in (run / "checkpoints").iterdir()}
        with contextlib.closing(RunCheckpoints(run, read_only=True)) as checkpoints:
            variables[name] = {path: stored.read() for path, stored in checkpoints.list_variables().items()}
            best[name] = checkpoints.best_step
    one, other = lines["plain"], lines["validated"]
    assert (list(one), list(other)) == ([2, 4, 6], [2, 3, 4, 6])
    for step in one:
        assert one[step]["loss"] == other[step]["loss"]
        assert one[step]["gradient_norm"] == other[step]["gradient_norm"]
    jax.tree.map(np.testing.assert_array_equal, variables["plain"], variables["validated"])
    assert (best["plain"], kept["plain"]) == (None, {6})

    scores = {step: line["validation/position_cm"] for step, line in other.items() if "validation/loss" in line}
    assert list(scores) == [3, 6]
    assert scores[best["validated"]] == min(scores.values())
    assert kept["validated"] == {6, best["validated"]}
    assert all(0 <= other[3][f"validation/{name}"] <= 1 for name in ("bin_exact", "bin_within_one", "gripper"))
    assert 0 < other[3]["validation/rotation_degrees"] <= 180


def test_what_cannot_be_validated_is_refused(tmp_path: Path):
    experiment = dataclasses.replace(small_run(tmp_path), oxe=OxeConfig(), validate_every=3)
    with pytest.raises(UserError, match="validate_every: nothing is held out of Open X-Embodiment"):
        train.main(experiment, tmp_path / "run", Watchdog(tmp_path / "processes"))
    assert not (tmp_path / "run").exists()
