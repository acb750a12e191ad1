"""Random episodes, examples and inputs of the network, by seed."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from data_pipelines.records import Episode, make_episode
from dsvla_jax.model.config import VisionConfig
from dsvla_jax.types import Array, Camera, Example, ModelInputs, Picture, Text


def random_episode(seed: int, task: str = "lamp_on", arms: int = 1, frames: int = 3, size: int = 8) -> Episode:
    """An episode with pictures of (size, size) pixels, seen by RLBench's front camera."""
    return seen_by_random_cameras(seed, (), task, arms, frames, size)


def seen_by_random_cameras(
    seed: int, cameras: Sequence[str], task: str = "lamp_on", arms: int = 1, frames: int = 3, size: int = 8
) -> Episode:
    """An episode seen by cameras of these names, a metre apart; without names by one camera."""
    rng, count = np.random.default_rng(seed), max(len(cameras), 1)
    camera = np.eye(4)
    camera[:3, :3] = [[0, -0.42262, -0.90631], [-1, 0, 0], [0, 0.90631, -0.42262]]
    camera[:3, 3] = 1.35, 0, 1.58
    poses = np.stack([camera] * count)
    poses[:, 1, 3] += np.arange(count)
    intrinsics = np.array([[-100, 0, size / 2], [0, -100, size / 2], [0, 0, 1]])
    rgb = rng.integers(0, 256, (frames, count, size, size, 3), np.uint8)
    depth = rng.uniform(0.5, 3, (frames, count, size, size))
    return make_episode(
        task=task,
        instruction=f"do {task} number {seed}",
        seed=seed,
        pictures=[
            Picture(colours, distances, Camera(np.stack([intrinsics] * count), poses))
            for colours, distances in zip(rgb, depth, strict=True)
        ],
        cameras=cameras,
        pose=rng.uniform(-1, 1, (frames, arms, 7)),
        gripper_open=rng.integers(0, 2, (frames, arms)),
        target_pose=rng.uniform(-1, 1, (frames, arms, 7)),
        target_gripper=rng.integers(0, 2, (frames, arms)),
        keypoints=rng.uniform(-1, 1, (arms, 2, 3)),
        active_keypoint=rng.uniform(-1, 1, (frames, arms, 3)),
    )


def random_example(
    rng: np.random.Generator, answer_mask: np.ndarray, vocabulary: int, size: int = 32
) -> Example[np.ndarray]:
    """A batch of examples without padding and without bins, one for each row of the (B, T) mask of answers."""
    batch, length = answer_mask.shape
    intrinsics = np.array([[-40, 0, size / 2], [0, -40, size / 2], [0, 0, 1]], np.float32)
    return Example(
        Picture(
            rng.integers(0, 255, (batch, 1, size, size, 3), np.uint8),
            rng.uniform(0.8, 1.2, (batch, 1, size, size)).astype(np.float32),
            Camera(
                np.broadcast_to(intrinsics, (batch, 1, 3, 3)),
                np.broadcast_to(np.eye(4, dtype=np.float32), (batch, 1, 4, 4)),
            ),
        ),
        Text(rng.integers(4, vocabulary, (batch, length)).astype(np.int32), np.ones((batch, length), bool)),
        answer_mask,
        number_rows=np.zeros((batch, length), np.int32),
    )


def text_example(tokens: np.ndarray, answer_mask: np.ndarray, number_rows: np.ndarray) -> Example[np.ndarray]:
    """A batch of examples with these texts, (B, T) each, without padding, and pictures of one pixel."""
    example = random_example(np.random.default_rng(0), answer_mask, 5, size=1)
    return replace(example, text=replace(example.text, tokens=tokens), number_rows=number_rows)


def random_inputs(
    vision: VisionConfig,
    tokens: range,
    lengths: np.ndarray,
    padded: int,
    points: int,
    seed: int = 0,
    cameras: int = 1,
) -> ModelInputs[Array]:
    """Inputs of a network with this vision tower: texts of these lengths, (B,), and so many 3D tokens.

    tokens: those that texts are made of. Padding is random too.
    """
    rng = np.random.default_rng(seed)
    batch, size = len(lengths), vision.image_size
    return ModelInputs(
        images=jnp.asarray(rng.normal(size=(batch, cameras, size, size, 3)), jnp.float32),
        point_tokens=jnp.asarray(rng.normal(size=(batch, points, vision.width)), jnp.float32),
        point_patches=jnp.asarray(rng.integers(0, cameras * vision.num_patches, (batch, points)), jnp.int32),
        text=Text(
            tokens=jnp.asarray(rng.integers(tokens.start, tokens.stop, (batch, padded)), jnp.int32),
            mask=jnp.arange(padded)[None] < jnp.asarray(lengths)[:, None],
        ),
    )
