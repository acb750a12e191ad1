"""What the device is, what its matrix unit attains, and the point tokenizer on it."""

import importlib.metadata
import os
import platform
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._accelerator.sections import Job
from benchmarks._timing import timed
from configs import get_config
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig, tokenize_points
from dsvla_jax.training.chips import PEAK_FLOPS

PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy", "grain")
PRODUCTS = 20


def devices(job: Job) -> None:
    """Devices and versions; bfloat16 products a second of one large matrix product."""
    device = jax.devices()[0]
    job.note(
        kind=device.device_kind,
        platform=device.platform,
        devices=len(jax.devices()),
        memory_gib=gib("bytes_limit"),
        processors=len(os.sched_getaffinity(0)),
        python=platform.python_version(),
        platform_version=device.client.platform_version,
        environment={name: value for name, value in os.environ.items() if name.startswith(("XLA_", "JAX_"))},
        **{name: version(name) for name in PACKAGES},
    )
    size = job.sizes.product
    left, right = (jax.random.normal(jax.random.key(n), (size, size), jnp.bfloat16) for n in range(2))

    @jax.jit
    def products(left: Any, right: Any) -> Any:
        # One after the other, each of which needs the one before.
        step = lambda _, x: (x @ right) * jnp.bfloat16(size**-0.5)  # noqa: E731
        return jax.lax.fori_loop(0, PRODUCTS, step, left)

    _, timing = timed(lambda: products(left, right), 5)
    job.note(
        product_tflops=PRODUCTS * 2 * size**3 / timing.median / 1e12,
        published_tflops=PEAK_FLOPS.get(device.device_kind, 0.0) / 1e12,
    )


def version(package: str) -> str:
    """Of an installed package; empty for one that is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def gib(name: str) -> float:
    """One of the device's own memory figures; 0 where it keeps none."""
    return (jax.devices()[0].memory_stats() or {}).get(name, 0) / 2**30


def points(job: Job) -> None:
    """Clouds a second of the paper's 3D tokenizer, with farthest point sampling and by itself."""
    config = get_config("paper_7b").encoding.points
    if job.sizes.name == "toy":
        config = PointTokenizerConfig(num_points=64, group_sizes=(16, 8), neighbours=4, width=32)
    rng = np.random.default_rng(0)
    sample = jax.jit(lambda clouds: farthest_point_sample(clouds, None, config.num_points))
    tokenize = jax.jit(jax.vmap(lambda cloud: tokenize_points(cloud, config)[0]))

    def both(clouds: Any) -> Any:
        return tokenize(jnp.take_along_axis(clouds, sample(clouds)[..., None], axis=1))

    for count in job.sizes.clouds:
        low, high = (np.array(config.center) + side * config.half_extent for side in (-1, 1))
        clouds = jnp.asarray(rng.uniform(low, high, (count, config.num_points, 3)), jnp.float32)
        _, sampling = timed(lambda clouds=clouds: sample(clouds), job.sizes.repeats)
        _, tokens = timed(lambda clouds=clouds: tokenize(clouds), job.sizes.repeats)
        _, whole = timed(lambda clouds=clouds: both(clouds), job.sizes.repeats)
        job.note(
            **{
                f"clouds {count}": {
                    "clouds_per_second": count / whole.median,
                    "sampling": sampling.figures(),
                    "tokenizer": tokens.figures(),
                }
            }
        )
