"""From a recorded frame to one training example: augmentation, prompt and answer, tokens.

Examples of one- and two-armed robots have the same shapes.
"""

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np

from data_pipelines.augment import jitter_state, perturb_keypoint, random_crop, random_offset, shift_world, vary_colour
from data_pipelines.episodes import Frame
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import build_prompt, encode_text
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.types import Example, HeldOutExample, RobotState


def vary(frame: Frame, rng: np.random.Generator, data: DataConfig) -> Frame:
    """The frame, varied as `data` says."""
    if data.shift_world > 0:
        # Horizontal only: the table, and with it the crop of the cloud, keeps its height.
        frame = shift_world(frame, random_offset(rng, (data.shift_world, data.shift_world, 0.0)))
    if data.crop < 1:
        frame = random_crop(frame, rng, data.crop)
    if data.colour_variation > 0:
        frame = vary_colour(frame, rng, data.colour_variation)
    if data.state_jitter > 0:
        frame = jitter_state(frame, rng, data.state_jitter, 0.5)
    if data.keypoint_noise > 0:
        frame = perturb_keypoint(frame, rng, data.keypoint_noise, data.keypoint_noise_probability)
    return frame


def without_variation(data: DataConfig) -> DataConfig:
    """The same data as they were recorded."""
    return dataclasses.replace(data, shift_world=0, crop=1, colour_variation=0, state_jitter=0, keypoint_noise=0)


def make_sampler(
    data: DataConfig, encoding: EncodingConfig, tokenizer: Tokenizer
) -> Callable[[Frame, np.random.Generator], Example[np.ndarray]]:
    """``sample(frame, rng)``: varies the frame as `data` says and writes its prompt and answer.

    Raises UserError where the tokenizer can not write answers number by number.
    """
    numbers = number_rows(tokenizer, encoding.style)
    codec = encoding.codec

    def sample(frame: Frame, rng: np.random.Generator) -> Example[np.ndarray]:
        frame = vary(frame, rng, data)
        prompt = build_prompt(
            encoding,
            frame.instruction,
            frame.robot,
            frame.keypoint if encoding.use_keypoints and len(frame.keypoint) else None,
        )
        bins = np.asarray(codec.encode(frame.target.pose, frame.target.gripper_open))
        answer = format_answer(bins, encoding.style)
        text, answer_mask = encode_text(tokenizer, prompt, answer, encoding.max_text_length)
        rows = np.zeros(len(text.tokens), np.int32)
        rows[answer_mask] = numbers.rows(bins)
        return Example(frame.pictures, text, answer_mask, rows)

    return sample


def require_texts_fit(encoding: EncodingConfig, tokenizer: Tokenizer, instructions: Iterable[tuple[str, int]]) -> None:
    """Raises UserError if an instruction's prompt and answer are longer than `max_text_length`.

    instructions: each with the number of arms of its task. The poses are ordinary ones: where the length of numbers
    varies, a sample may still be somewhat longer.
    """
    for text, arms in instructions:
        pose = np.tile(np.array([0.2, 0.1, 0.9, 0, 1, 0, 0], np.float32), (arms, 1))
        robot = RobotState(pose, np.ones(arms, np.float32))
        prompt = build_prompt(encoding, text, robot, np.zeros((arms, 3), np.float32))
        answer = format_answer(np.asarray(encoding.codec.encode(pose, robot.gripper_open)), encoding.style)
        encode_text(tokenizer, prompt, answer, encoding.max_text_length)


def make_validation_sampler(
    data: DataConfig, encoding: EncodingConfig, tokenizer: Tokenizer
) -> Callable[[Frame, np.random.Generator], HeldOutExample[np.ndarray]]:
    """Returns `sample(frame, rng)` for validation: as `make_sampler`, of frames as they were recorded."""
    plain = make_sampler(without_variation(data), encoding, tokenizer)
    numbers = number_rows(tokenizer, encoding.style)

    def sample(frame: Frame, rng: np.random.Generator) -> HeldOutExample[np.ndarray]:
        one = plain(frame, rng)
        bins = np.asarray(encoding.codec.encode(frame.target.pose, frame.target.gripper_open))
        integers = np.zeros((2, bins.shape[1]), np.int32)
        integers[: len(bins)] = bins
        number_of = np.zeros_like(one.number_rows)
        number_of[one.answer_mask] = numbers.numbers(bins)
        return HeldOutExample(one, integers, number_of)

    return sample
