"""A tiny random policy behind a real server on a free port, and observations for it."""

import asyncio
import contextlib
import threading
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import numpy as np

from dsvla_jax.data_config import LearnedFrom
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.three_ds_vla import TextPolicy
from dsvla_jax.serving.server import Limits, PolicyServer
from tests.small import small_encoding, small_language, small_vision

SIZE = 32
PROMPTS = ("turn on the light", "close the fridge", "lift the ball", "press the red button")


def tiny_policy(
    use_keypoints: bool = True, use_points: bool = True, words: Iterable[str] = PROMPTS, cameras: tuple[str, ...] = ()
) -> TextPolicy:
    """Random weights, larger than at initialisation, so that different observations get different answers."""
    tokenizer = WordTokenizer(vocabulary(words))
    encoding = small_encoding(max_text_length=48, use_keypoints=use_keypoints, use_points=use_points)
    model = ModelConfig(
        vision=small_vision(),
        language=small_language(tokenizer.vocab_size),
        cameras=max(len(cameras), 1),
    )
    learned = LearnedFrom("simulator", "oracle", (SIZE, SIZE), (1,), ("lamp_on",), cameras) if cameras else None
    variables = jax.tree.map(lambda x: 3.0 * x, initialize(model, jax.random.key(0)))
    return TextPolicy(PolicyConfig(encoding, model, learned_from=learned), variables, tokenizer)


def observation(seed: int, arms: int = 1, size: int = SIZE) -> dict[str, Any]:
    """A well-formed request; every seed gives another."""
    rng, camera = np.random.default_rng(seed), front_camera(size)
    quaternions = rng.normal(size=(arms, 4))
    return {
        "prompt": PROMPTS[seed % len(PROMPTS)],
        "rgb": rng.integers(0, 256, (size, size, 3), dtype=np.uint8),
        "depth": rng.uniform(0.8, 1.4, (size, size)).astype(np.float32),
        "intrinsics": np.asarray(camera.intrinsics),
        "world_from_camera": np.asarray(camera.world_from_camera),
        "pose": np.concatenate(
            [
                rng.uniform([0.0, -0.4, 0.8], [0.5, 0.4, 1.4], (arms, 3)),
                quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True),
            ],
            axis=-1,
        ).astype(np.float32),
        "gripper_open": rng.integers(0, 2, arms).astype(np.float32),
        "keypoints": rng.uniform([0.0, -0.4, 0.8], [0.5, 0.4, 1.4], (arms, 2, 3)).astype(np.float32),
    }


@contextlib.contextmanager
def running(server_of: Any) -> Iterator[tuple[PolicyServer, int]]:
    """The server that ``server_of()`` makes, in a thread of its own, ready; and its port."""
    started, result, stop = threading.Event(), [], []

    async def main() -> None:
        server, ended = server_of(), asyncio.Event()
        stop.append((asyncio.get_running_loop(), ended))
        async with server.listen("127.0.0.1", 0) as sockets:
            result.append((server, sockets.sockets[0].getsockname()[1]))
            started.set()
            await ended.wait()

    thread = threading.Thread(target=lambda: asyncio.run(main()), daemon=True)
    thread.start()
    while not started.wait(0.1):
        if not thread.is_alive():
            raise RuntimeError("the server did not start; its traceback is above")
    try:
        yield result[0]
    finally:
        loop, ended = stop[0]
        loop.call_soon_threadsafe(ended.set)
        thread.join(20)


def small_server(policy: TextPolicy | None = None, **options: Any) -> PolicyServer:
    """A server of 32 x 32 pixels, one arm and batches of at most 2."""
    limits = Limits(**{"batch": 2, "message_seconds": 1.0, **options.pop("limits", {})})
    return PolicyServer(policy or tiny_policy(), [(SIZE, SIZE)], [1], limits, **options)
