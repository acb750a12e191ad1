"""The 3D tokenizer takes a quarter of a plain Point-NN's time in PyTorch, sampling half of fpsample's C++ (2 minutes).

Usage: python -m benchmarks.point_tokenizer_speed. Needs torch (see `make parity`) and fpsample (pip install fpsample).
8 clouds of 2048 points, 16 neighbours, 576 tokens, on a CPU. Both sides have the same number of threads (fpsample has
one), run by turns, and the fastest run of each counts; indices and tokens are compared first.
"""

import os
import sys
import time
from collections.abc import Callable
from typing import Any

import fpsample  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from dsvla_jax.command_line import configure_jax
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig, tokenize_points

CONFIG = PointTokenizerConfig()
BATCH, ROUNDS = 8, 8
SAMPLING, TOKENIZER = 2.0, 4.0


def torch_sample(points: torch.Tensor, count: int) -> torch.Tensor:
    """Farthest point sampling, the usual loop: (B, P, 3) -> indices (B, count)."""
    batch = torch.arange(len(points))
    distance = torch.full(points.shape[:2], torch.inf)
    chosen = torch.zeros(len(points), count, dtype=torch.long)
    for i in range(1, count):
        last = points[batch, chosen[:, i - 1]]
        distance = torch.minimum(distance, ((points - last[:, None]) ** 2).sum(-1))
        chosen[:, i] = distance.argmax(1)
    return chosen


def torch_encode(coordinates: torch.Tensor, channels: int) -> torch.Tensor:
    """Point-NN's trigonometric encoding; the channels that 6 does not divide are zero."""
    frequencies = channels // 6
    steps = CONFIG.beta / CONFIG.alpha ** (torch.arange(frequencies) / frequencies)
    angles = coordinates[..., None] * steps
    waves = torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(-3)
    return torch.nn.functional.pad(waves, (0, channels - waves.shape[-1]))


def torch_tokens(points: torch.Tensor) -> torch.Tensor:
    """Point-NN's stages as it writes them: sample, group, concatenate, encode, add, maximum."""
    scaled = (points - torch.tensor(CONFIG.center)) / CONFIG.half_extent
    features = torch_encode(scaled, CONFIG.base_width)
    batch = torch.arange(len(points))[:, None]
    for count in CONFIG.group_sizes:
        chosen = torch_sample(scaled, count)
        centres, own = scaled[batch, chosen], features[batch, chosen]
        nearest = torch.cdist(centres, scaled, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = nearest.topk(CONFIG.neighbours, largest=False).indices
        relative = scaled[batch[..., None], nearest] - centres[:, :, None]
        relative = relative / (relative.flatten(1).std(1) + 1e-5)[:, None, None, None]
        grouped = features[batch[..., None], nearest]
        grouped = torch.cat([grouped, own[:, :, None].expand_as(grouped)], dim=-1)
        features = (grouped + torch_encode(relative, grouped.shape[-1])).amax(2)
        scaled = centres
    mean, deviation = features.mean(-1, keepdim=True), features.std(-1, correction=0, keepdim=True)
    return (features - mean) / (deviation + 1e-5) * CONFIG.token_rms


def fastest(ours: Callable[[], Any], theirs: Callable[[], Any]) -> tuple[float, float]:
    """Milliseconds of each, by turns."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for side, run in zip(times, (ours, theirs), strict=True):
            start = time.perf_counter()
            run()
            side.append(1e3 * (time.perf_counter() - start))
    return min(times[0]), min(times[1])


def report(what: str, ours: float, theirs: float, required: float) -> bool:
    print(f"{what}: {ours:.1f} ms, {theirs:.1f} ms: {theirs / ours:.1f} times as fast (at least {required:g})")
    return theirs >= required * ours


def main() -> int:
    configure_jax()
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    rng = np.random.default_rng(0)
    clouds = np.asarray(rng.uniform(-0.5, 0.5, (BATCH, CONFIG.num_points, 3)) + CONFIG.center, np.float32)
    count = CONFIG.num_tokens
    sample = jax.jit(lambda points: farthest_point_sample(points, None, count))
    order = jax.jit(lambda points: farthest_point_sample(points, None, CONFIG.num_points))
    tokens = jax.jit(jax.vmap(lambda points: tokenize_points(points, CONFIG)[0]))
    on_device = jnp.asarray(clouds)

    def their_sample() -> np.ndarray:
        return np.stack([fpsample.fps_sampling(cloud, count, start_idx=0) for cloud in clouds])

    if not np.array_equal(sample(on_device), their_sample()):
        print("farthest point sampling: indices differ from fpsample's")
        return 1
    ours, theirs = fastest(lambda: sample(on_device).block_until_ready(), their_sample)
    fine = report(f"sampling {count} of {CONFIG.num_points} points, against fpsample", ours, theirs, SAMPLING)

    # The tokenizer takes clouds in farthest-point order; the peer samples them again, which gives the same centres.
    ordered = np.take_along_axis(clouds, np.asarray(order(on_device))[..., None], axis=1)
    on_device, on_torch = jnp.asarray(ordered), torch.from_numpy(ordered)
    difference = np.abs(np.asarray(tokens(on_device)) - torch_tokens(on_torch).numpy())
    print(f"tokens: largest difference {difference.max():.1e}, of values of root mean square {CONFIG.token_rms:g}")
    if difference.max() > 1e-2:
        return 1

    def ours_with_sampling() -> None:
        chosen = order(on_device)
        tokens(jnp.take_along_axis(on_device, chosen[..., None], axis=1)).block_until_ready()

    ours, theirs = fastest(ours_with_sampling, lambda: torch_tokens(on_torch))
    fine &= report("tokenizer with its sampling, against torch", ours, theirs, TOKENIZER)
    return int(not fine)


if __name__ == "__main__":
    sys.exit(main())
